"""`on_limit: latest` sends the newest in time."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from tests.engine.rig import Destination, play, serve
from tests.oracles.python_engine.delivery import immediately
from tests.oracles.python_engine.pacing import NS, Latest

MS = 1_000_000


class Held:
    """A Latest for a destination, and when what arrived there."""

    def __init__(self, hertz: float) -> None:
        self.destination = Destination()
        self.arrived: list[tuple[int, int]] = []
        hand_over = immediately(lambda *_: None, self.destination.outcome)

        def deliver(now: int, data: bytes, expires: int | None) -> None:
            self.arrived.append((now, int(data)))
            hand_over(now, data, expires)

        self.latest = Latest(hertz, deliver, self.destination.outcome)

    def offer(self, now: int, number: int, expires: int | None = None) -> None:
        self.latest.offer(now, b"%d" % number, expires)

    def play(self, times: list[int], late: int = 0) -> None:
        """Offers 0, 1, 2... at these times, and then waits for ten seconds."""
        events = ((time, lambda now, number=number: self.offer(now, number)) for number, time in enumerate(times))
        play(self.latest, events, times[-1] + 10 * NS, late)

    @property
    def times(self) -> list[int]:
        return [time for time, _ in self.arrived]


def test_the_first_goes_at_once_and_of_the_others_the_newest_when_it_may() -> None:
    held = Held(10)
    held.play([0, 10 * MS, 20 * MS, 40 * MS])
    assert held.arrived == [(0, 0), (50 * MS, 3)]
    assert held.destination.counted() == {"datagrams_sent": 2, "sent_bytes": 2, "rate_limited": 2}
    assert held.destination.reports == []


def test_one_that_may_pass_by_itself_takes_the_place_of_one_that_still_waits() -> None:
    """Whoever serves the machine is late."""
    held = Held(10)
    held.offer(0, 0)
    held.offer(20 * MS, 1)
    held.offer(51 * MS, 2)
    serve(held.latest, NS)
    assert held.arrived == [(0, 0), (51 * MS, 2)]


def test_what_gets_too_old_while_it_waits_is_dropped_and_takes_no_place() -> None:
    held = Held(10)
    held.offer(0, 0)
    held.offer(10 * MS, 1, expires=50 * MS - 1)
    serve(held.latest, 50 * MS)
    assert held.destination.counted()["stale"] == 1
    held.offer(50 * MS, 2, expires=50 * MS)
    assert held.arrived == [(0, 0), (50 * MS, 2)]


def test_it_is_not_disturbed_by_being_called_too_early() -> None:
    held = Held(10)
    held.latest.due(0)
    held.offer(0, 0)
    held.offer(10 * MS, 1)
    held.latest.due(20 * MS)
    serve(held.latest, NS)
    assert held.arrived == [(0, 0), (50 * MS, 1)]


def test_at_the_end_what_is_held_goes_ahead_of_its_time_unless_it_is_too_old() -> None:
    for expires, arrived in ((20 * MS, [(0, 0), (20 * MS, 1)]), (20 * MS - 1, [(0, 0)])):
        held = Held(10)
        held.offer(0, 0)
        held.offer(10 * MS, 1, expires)
        held.latest.end(20 * MS)
        held.latest.end(20 * MS)
        assert held.arrived == arrived
        assert held.latest.next_due is None
        assert held.destination.counted().get("stale", 0) == 2 - len(arrived)


arrivals = st.lists(st.floats(0, 3), min_size=1, max_size=100)
"""Times between messages, in periods."""


@given(st.integers(1, 1000), arrivals, st.floats(0, 0.4))
def test_whatever_comes_the_newest_gets_there_soon_and_in_order(hertz: int, gaps: list[float], late: float) -> None:
    """Within half a period of its arrival, and later only by what the timer thread is."""
    held, period = Held(hertz), -(-NS // hertz)
    times = list(itertools.accumulate(round(gap * period) for gap in gaps))
    held.play(times, late=int(late * period))

    numbers = [number for _, number in held.arrived]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == len(times) - 1
    assert all(time - times[number] <= period + late * period for time, number in held.arrived)
    counted = held.destination.counted()
    assert counted["datagrams_sent"] + counted.get("rate_limited", 0) == len(times)


@given(st.integers(1, 100), st.lists(st.floats(0, 0.5), min_size=2, max_size=50))
def test_a_stream_not_above_the_rate_is_not_held_back(hertz: int, delays: list[float]) -> None:
    period = -(-NS // hertz)
    times = [index * period + int(delay * period) for index, delay in enumerate(delays)]
    held = Held(hertz)
    held.play(times)
    assert held.times == times

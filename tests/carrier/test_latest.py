"""`on_limit: latest` sends the newest in time."""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.carrier.deferring import Deferring

NS, MS = 1_000_000_000, 1_000_000


class Held:
    """A target with `on_limit: latest`, and when what arrived there."""

    def __init__(self, deferring: Deferring, hertz: float, *, is_topic: bool = False) -> None:
        self.deferring = deferring
        self.hertz = hertz
        self.target = deferring.target(hertz, is_topic=is_topic)
        self._is_written = is_topic
        self.arrived: list[tuple[int, int]] = []

    def offer(self, now: int, number: int, expires: int | None = None) -> None:
        self.deferring.set(now)
        self.deferring.offer(self.target, b"%d" % number, expires, is_written=self._is_written)
        self._collect()

    def serve(self, until: int) -> None:
        self.deferring.wait(until)
        self._collect()

    def play(self, times: list[int], late: int = 0) -> None:
        """Offer 0, 1, 2... at these times, and then wait for ten seconds. The thread serves `late` ns behind."""
        for number, time in enumerate([*times, times[-1] + 10 * NS]):
            while (due := self.deferring.next_due) is not None and max(due + late, self.deferring.now) <= time:
                self.deferring.set(max(due + late, self.deferring.now))
                self.deferring.serve()
            if number < len(times):
                self.offer(time, number)
        self._collect()

    def _collect(self) -> None:
        self.arrived += [(each.at, int(each.data)) for each in self.deferring.taken()]

    def counted(self) -> dict[str, int]:
        return self.deferring.counted(self.target)

    @property
    def times(self) -> list[int]:
        return [time for time, _ in self.arrived]


@contextmanager
def held_by(library: ctypes.CDLL, functions: ctypes.CDLL, hertz: float, *, is_topic: bool = False) -> Iterator[Held]:
    opened = Deferring(library, functions)
    try:
        yield Held(opened, hertz, is_topic=is_topic)
    finally:
        opened.close()


@pytest.fixture(params=["endpoint", "topic"])
def held(library: ctypes.CDLL, deferring: ctypes.CDLL, request: pytest.FixtureRequest) -> Iterator[Held]:
    with held_by(library, deferring, 10, is_topic=request.param == "topic") as opened:
        yield opened


def test_the_first_goes_at_once_and_of_the_others_the_newest_when_it_may(held: Held) -> None:
    held.play([0, 10 * MS, 20 * MS, 40 * MS])
    assert held.arrived == [(0, 0), (50 * MS, 3)]
    assert held.counted()["sent"] == held.counted()["rate_limited"] == 2


def test_one_that_may_pass_by_itself_takes_the_place_of_one_that_still_waits(held: Held) -> None:
    """Whoever serves the timers is late."""
    held.offer(0, 0)
    held.offer(20 * MS, 1)
    held.offer(51 * MS, 2)
    held.serve(NS)
    assert held.arrived == [(0, 0), (51 * MS, 2)]


def test_it_is_not_disturbed_by_being_served_too_early(held: Held) -> None:
    held.deferring.serve()
    held.offer(0, 0)
    held.offer(10 * MS, 1)
    held.deferring.set(20 * MS)
    held.deferring.serve()
    held.serve(NS)
    assert held.arrived == [(0, 0), (50 * MS, 1)]


@pytest.mark.parametrize(("expires", "arrived"), [(20 * MS, [0, 1]), (20 * MS - 1, [0])])
def test_at_the_end_what_is_held_goes_ahead_of_its_time_unless_it_is_too_old(
    held: Held, expires: int, arrived: list[int]
) -> None:
    held.offer(0, 0)
    held.offer(10 * MS, 1, expires)
    held.deferring.set(20 * MS)
    held.deferring.end(held.target)
    held.serve(NS)
    assert held.arrived == [(20 * MS * number, number) for number in arrived]
    assert held.deferring.next_due is None
    assert held.counted().get("stale", 0) == 2 - len(arrived)


@pytest.mark.parametrize("happens", ["is due", "ends", "gets another rate", "all end"])
def test_a_thread_that_is_given_up_in_the_middleware_uses_no_deferral_any_more(
    library: ctypes.CDLL, deferring: ctypes.CDLL, happens: str
) -> None:
    """Its owner frees them."""
    group = Deferring(library, deferring)
    targets = [group.target(10, is_topic=True) for _ in range(3)]
    for target in targets * 2:
        group.offer(target, b"", is_written=True)
    group.give_up()
    group.set(NS)
    match happens:
        case "is due":
            group.serve()
        case "ends":
            group.end(targets[1])
        case "gets another rate":
            group.change(targets[1], 5)
        case _:
            group.end_all()
    assert group.is_untouched
    group.close()


def test_what_is_held_goes_along_to_the_next_program(held: Held) -> None:
    held.offer(0, 0)
    held.offer(10 * MS, 1)
    later = held.deferring.change(held.target, held.hertz)
    held.serve(NS)
    assert held.arrived == [(0, 0), (50 * MS, 1)]
    assert (held.counted()["sent"], held.deferring.counted(later)["sent"]) == (1, 1)


def test_with_another_rate_what_is_held_leaves_at_once_and_the_limit_begins_anew(held: Held) -> None:
    held.offer(0, 0)
    held.offer(10 * MS, 1)
    held.deferring.set(11 * MS)
    held.target = held.deferring.change(held.target, 5)
    held.offer(12 * MS, 2)
    held.offer(13 * MS, 3)
    held.serve(NS)
    assert held.arrived == [(0, 0), (11 * MS, 1), (12 * MS, 2), (112 * MS, 3)]


def test_what_is_refused_is_counted_when_it_leaves(held: Held) -> None:
    held.offer(0, 0)
    held.offer(10 * MS, 1)
    held.deferring.refuse(5)
    held.serve(NS)
    lost = held.counted()
    assert lost.get("send_error", 0) + lost.get("publish_error", 0) == 1
    assert lost["sent"] == 1


arrivals = st.lists(st.floats(0, 3), min_size=1, max_size=100)
"""Times between messages, in periods."""


@given(st.integers(1, 1000), arrivals, st.floats(0, 0.4))
def test_whatever_comes_the_newest_gets_there_soon_and_in_order(
    library: ctypes.CDLL, deferring: ctypes.CDLL, hertz: int, gaps: list[float], late: float
) -> None:
    """Within half a period of its arrival, and later only by what the thread is."""
    period = -(-NS // hertz)
    times = list(itertools.accumulate(round(gap * period) for gap in gaps))
    with held_by(library, deferring, hertz) as held:
        held.play(times, late=int(late * period))
        numbers = [number for _, number in held.arrived]
        assert numbers == sorted(set(numbers))
        assert numbers[-1] == len(times) - 1
        assert all(time - times[number] <= period + late * period for time, number in held.arrived)
        counted = held.counted()
    assert counted["sent"] + counted.get("rate_limited", 0) == len(times)


@given(st.integers(1, 100), st.lists(st.floats(0, 0.5), min_size=2, max_size=50))
def test_a_stream_not_above_the_rate_is_not_held_back(
    library: ctypes.CDLL, deferring: ctypes.CDLL, hertz: int, delays: list[float]
) -> None:
    period = -(-NS // hertz)
    times = [index * period + int(delay * period) for index, delay in enumerate(delays)]
    with held_by(library, deferring, hertz) as held:
        held.play(times)
        assert held.times == times

"""A deadman trips in time, repeats on its grid, and never speaks behind a fresh command."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import replace
from typing import ParamSpec, TypeVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.metrics import Counters, Report
from router.compiler.program import DeadmanPlan
from tests.oracles.python_engine.deadman import GREETING, START, START_AGAIN, Deadman, commander, feeder
from tests.oracles.python_engine.delivery import Stale
from tests.oracles.python_engine.timers import Timer

P = ParamSpec("P")
R = TypeVar("R")

TIMEOUT = 500
REPEAT = 100
PLAN = DeadmanPlan("drive", TIMEOUT, REPEAT, (("driving_board", b"brake"), ("arm_board", b"hold")))
FAULT = OSError(errno.ENETUNREACH, "Network is unreachable")


class Watched:
    """A deadman and everything that came out of it.

    Datagrams are recorded with the time of the call, `now`; what it told, with how many were sent by then and
    what the gauge said.
    """

    def __init__(self, plan: DeadmanPlan = PLAN) -> None:
        self.now = 0
        self.sent: list[tuple[int, str, bytes]] = []
        self.failures: dict[str, Exception] = {}
        self.reports: list[Report] = []
        self.told: list[tuple[str, bool, int, int]] = []
        self.counters = Counters()
        self._counts = [0] * 100
        send = {endpoint: self._sender(endpoint) for endpoint, _ in plan.datagrams}
        self.deadman = Deadman(plan, self.counters, self._counts, send, self.reports.append, self._changed)

    def feed(self, now: int) -> None:
        self.now = now
        self.deadman.feed(now)

    def due(self, now: int) -> None:
        self.now = now
        self.deadman.due(now)

    def run(self, until: int) -> None:
        """What a timer thread does that is never late."""
        while self.deadman.next_due is not None and self.deadman.next_due <= until:
            self.due(self.deadman.next_due)

    def times(self, endpoint: str = "driving_board") -> list[int]:
        return [time for time, name, _ in self.sent if name == endpoint]

    def count(self, metric: str, *labels: str) -> int:
        return self._counts[self.counters.index(metric, "drive", *labels)]

    def _changed(self, route: str, active: bool) -> None:
        self.told.append((route, active, len(self.sent), self.count("deadman_active")))

    def _sender(self, endpoint: str) -> Callable[[bytes], int]:
        def send(datagram: bytes) -> int:
            if endpoint in self.failures:
                raise self.failures[endpoint]
            self.sent.append((self.now, endpoint, datagram))
            return len(datagram)

        return send


def test_without_a_command_nothing_is_ever_due() -> None:
    watched = Watched()
    watched.due(10**12)
    watched.deadman.end(0)
    assert (watched.deadman.next_due, watched.sent, watched.told) == (None, [], [])


def test_it_is_active_and_has_sent_when_it_tells_that_it_tripped() -> None:
    watched = Watched()
    watched.feed(0)
    watched.run(TIMEOUT)
    assert watched.told == [("drive", True, 2, 1)]


def test_a_lost_datagram_is_counted_and_reported_and_ends_nothing() -> None:
    watched = Watched()
    watched.failures["driving_board"] = FAULT
    watched.feed(0)
    watched.run(TIMEOUT + REPEAT)
    watched.failures.clear()
    watched.run(TIMEOUT + 2 * REPEAT)
    assert watched.times() == [700]
    assert watched.times("arm_board") == [500, 600, 700]
    assert watched.reports == 2 * [Report("deadman", "drive", "driving_board", "send_error", FAULT)]
    counted = [
        watched.count(metric, endpoint)
        for endpoint in ("driving_board", "arm_board")
        for metric in ("deadman_datagrams_sent", "deadman_send_errors")
    ]
    assert counted == [1, 2, 3, 0]


def test_a_fault_of_ours_goes_up_and_the_repeating_goes_on() -> None:
    watched = Watched()
    watched.failures["driving_board"] = LookupError("a bug")
    watched.feed(0)
    with pytest.raises(LookupError):
        watched.due(TIMEOUT)
    assert (watched.deadman.next_due, watched.count("deadman_active")) == (TIMEOUT + REPEAT, 1)


@pytest.mark.parametrize("now", [10, TIMEOUT + 10], ids=["armed", "tripped"])
def test_at_the_end_it_sends_once_more_and_then_nothing(now: int) -> None:
    watched = Watched()
    watched.feed(0)
    watched.run(now)
    watched.sent.clear()
    watched.deadman.end(0)
    watched.run(10**6)
    assert [endpoint for _, endpoint, _ in watched.sent] == ["driving_board", "arm_board"]


def test_who_takes_over_disarms_it_until_its_own_next_command() -> None:
    watched = Watched()
    watched.feed(0)
    watched.deadman.disarm(TIMEOUT - 1)
    watched.due(10 * TIMEOUT)
    watched.deadman.end(0)
    assert (watched.deadman.next_due, watched.sent, watched.told) == (None, [], [])
    watched.feed(20 * TIMEOUT)
    watched.run(21 * TIMEOUT)
    assert watched.times() == [21 * TIMEOUT]


def test_who_takes_over_releases_it_when_it_has_tripped() -> None:
    watched = Watched()
    watched.feed(0)
    watched.run(TIMEOUT + REPEAT)
    watched.deadman.disarm(TIMEOUT + REPEAT + 1)
    watched.run(10**6)
    assert watched.times() == [TIMEOUT, TIMEOUT + REPEAT]
    assert [told[:2] for told in watched.told] == [("drive", True), ("drive", False)]
    assert (watched.count("deadman_active"), watched.count("deadman_trips")) == (0, 1)


@pytest.mark.parametrize(("told", "armed"), [(["a"], {"a"}), (["a", "b", "c"], {"a"}), (["b", "c"], set())])
def test_one_call_feeds_the_own_deadman_and_disarms_the_others(told: list[str], armed: set[str]) -> None:
    deadmen = {name: Watched().deadman for name in "abc"}
    for name in "bc":
        deadmen[name].feed(0)
    served: list[Timer] = []

    def locked(timer: Timer, call: Callable[P, R], /) -> Callable[P, R]:
        served.append(timer)
        return call

    feeder(deadmen, locked)("a", told)(TIMEOUT)
    assert served == [deadmen[told[0]]]
    assert {name for name in told if deadmen[name].next_due is not None} == armed


def test_a_command_is_checked_sent_and_fed_under_the_lock_and_one_that_fails_feeds_nothing() -> None:
    watched, taken = Watched(), list[str]()

    def locked(timer: Timer, call: Callable[P, R], /) -> Callable[P, R]:
        def with_lock(*args: P.args, **kwargs: P.kwargs) -> R:
            taken.append("lock")
            try:
                return call(*args, **kwargs)
            finally:
                taken.append("unlock")

        return with_lock

    def send(data: bytes) -> int:
        taken.append(f"send, due at {watched.deadman.next_due}")
        if data == b"fails":
            raise PermissionError(errno.EPERM, "Operation not permitted")
        return len(data)

    command = commander({"board": send}, {"drive": watched.deadman}, locked, lambda: watched.now)
    send_command, send_other = command("board", "drive", ("drive",)), command("board", "status", ())
    assert send_command(b"12", 0) == 2
    assert (taken, watched.deadman.next_due) == (["lock", "send, due at None", "unlock"], TIMEOUT)
    watched.now = 1
    with pytest.raises(Stale):
        send_command(b"12", 0)
    assert (taken[3:], watched.deadman.next_due) == (["lock", "unlock"], TIMEOUT)
    with pytest.raises(PermissionError):
        send_command(b"fails", None)
    assert (taken[5:], watched.deadman.next_due) == (["lock", f"send, due at {TIMEOUT}", "unlock"], TIMEOUT)
    with pytest.raises(Stale):
        send_other(b"12", 0)
    assert send_other(b"123", None) == 3
    assert taken[8:] == [f"send, due at {TIMEOUT}"]


gaps = st.lists(st.integers(0, 5 * TIMEOUT), min_size=1, max_size=30)


def expected(feeds: list[int], end: int) -> list[int]:
    """When a deadman sends that is served in time: from each silence's timeout on, until the next command."""
    silences = zip(feeds, [*feeds[1:], end + 1], strict=True)
    return [time for fed, next_fed in silences for time in range(fed + TIMEOUT, next_fed, REPEAT)]


@given(gaps)
def test_it_sends_exactly_in_the_silences(gaps: list[int]) -> None:
    watched, now, feeds = Watched(), 0, []
    for gap in gaps:
        now += gap
        watched.run(now - 1)
        watched.feed(now)
        feeds.append(now)
    watched.run(now + 3 * TIMEOUT)
    assert watched.times() == expected(feeds, now + 3 * TIMEOUT)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2 * TIMEOUT)), max_size=60))
def test_served_at_any_time_it_neither_speaks_too_soon_nor_twice_for_one_repeat(calls: list[tuple[bool, int]]) -> None:
    watched, now, fed = Watched(), 0, None
    for is_command, gap in calls:
        now += gap
        before = len(watched.times())
        if is_command:
            watched.feed(now)
            fed = now
            assert len(watched.times()) == before
            continue
        watched.due(now)
        sent = watched.times()[before:]
        if fed is None or now < fed + TIMEOUT:
            assert sent == []
            continue
        index = (now - fed - TIMEOUT) // REPEAT
        earlier = [(time - fed - TIMEOUT) // REPEAT for time in watched.times()[:before] if time > fed]
        assert sent == ([] if index in earlier else [now])


def succession(before: Watched, plan: DeadmanPlan) -> Watched:
    """One whose endpoints are the same but for the arm board, and which takes the place of `before`."""
    after = Watched(plan)
    after.deadman._destinations[0] = before.deadman._destinations[0]
    after.deadman.replace(before.deadman)
    return after


def test_one_that_was_replaced_trips_no_more_and_has_its_last_word_where_the_other_has_none() -> None:
    before = Watched()
    before.feed(0)
    succession(before, PLAN)
    before.run(10 * TIMEOUT)
    assert (before.sent, before.count("deadman_active"), before.count("deadman_trips")) == ([], 0, 0)
    before.deadman.end(10 * TIMEOUT)
    assert [endpoint for _, endpoint, _ in before.sent] == ["arm_board"]


def test_one_that_tripped_hands_on_when_it_sent_last() -> None:
    before = Watched()
    before.feed(0)
    before.run(TIMEOUT)
    after = succession(before, DeadmanPlan("drive", 10 * TIMEOUT, REPEAT // 4, PLAN.datagrams))
    assert after.deadman.next_due == TIMEOUT + REPEAT // 4


def test_a_command_that_waited_since_before_a_reload_feeds_the_one_that_acts_now() -> None:
    before = Watched()
    between = succession(before, PLAN)
    after = succession(between, DeadmanPlan("drive", 2 * TIMEOUT, REPEAT, PLAN.datagrams))
    for number, deadman in enumerate((before.deadman, between.deadman, after.deadman)):
        deadman.feed(number)
        assert after.deadman.next_due == number + 2 * TIMEOUT
    before.deadman.disarm(0)
    assert [each.deadman.next_due for each in (before, between, after)] == [None, None, None]


def test_at_the_start_it_sends_once_and_is_neither_armed_nor_tripped() -> None:
    refused = ConnectionRefusedError(errno.ECONNREFUSED, "the board is off")
    watched = Watched()
    watched.failures["arm_board"] = refused
    assert watched.deadman.start(0) == ["driving_board"]
    watched.run(10**12)
    watched.deadman.end(0)
    assert watched.sent == [(0, "driving_board", b"brake")]
    assert watched.reports == [Report("deadman", "drive", "arm_board", "send_error", refused)]
    assert (watched.told, watched.deadman.next_due, watched.count("deadman_trips")) == ([], None, 0)


@pytest.mark.parametrize("is_replaced", [False, True])
def test_what_cannot_leave_at_the_start_is_sent_again_until_it_has_left(is_replaced: bool) -> None:
    watched = Watched()
    watched.failures["arm_board"] = FAULT
    watched.deadman.start(0)
    if is_replaced:
        watched = succession(watched, PLAN)
        watched.failures["arm_board"] = FAULT
    watched.run(2 * START_AGAIN)
    del watched.failures["arm_board"]
    watched.sent.clear()
    watched.run(10 * START_AGAIN)
    watched.deadman.end(0)
    assert watched.times("arm_board") == [3 * START_AGAIN]
    assert (watched.told, watched.deadman.next_due, watched.count("deadman_trips")) == ([], None, 0)


def test_a_command_ends_the_start() -> None:
    watched = Watched()
    watched.failures["arm_board"] = FAULT
    watched.deadman.start(0)
    watched.feed(1)
    watched.run(TIMEOUT)
    assert watched.count("deadman_trips") == 0
    watched.deadman.disarm(TIMEOUT)
    watched.run(10 * START_AGAIN)
    assert watched.times() == [0]


def test_one_that_is_silent_at_the_start_sends_nothing() -> None:
    watched = Watched(replace(PLAN, at_start=False))
    assert watched.deadman.start(0) == []
    watched.deadman.await_subscribers(0)
    assert watched.deadman.greet(1) == []
    assert (watched.sent, watched.deadman.next_due) == ([], None)


def test_shortly_after_the_start_each_new_subscriber_is_sent_to_twice_until_a_command_comes() -> None:
    watched = Watched()
    watched.deadman.await_subscribers(0)
    meetings = (5, START - 1, START, START + 1)
    for now in meetings:
        watched.run(now)
        watched.now = now
        watched.deadman.greet(now)
    watched.run(10 * START)
    assert watched.times() == [5, 5 + GREETING, START - 1, START - 1 + GREETING]
    assert watched.told == []


def test_a_command_ends_the_meetings_of_the_start() -> None:
    watched = Watched()
    watched.deadman.await_subscribers(0)
    watched.deadman.greet(5)
    watched.feed(10)
    assert watched.deadman.greet(20) == []
    watched.run(10 + TIMEOUT)
    assert watched.times() == [0, 10 + TIMEOUT]
    assert watched.count("deadman_trips") == 1


@pytest.mark.parametrize("is_replaced", [False, True])
def test_at_the_end_a_meeting_is_no_command(is_replaced: bool) -> None:
    watched = Watched()
    watched.deadman.await_subscribers(0)
    watched.deadman.greet(5)
    if is_replaced:
        after = succession(watched, PLAN).deadman
        assert (after.next_due, watched.deadman.next_due) == (None, None)
        assert after.greet(10) == ["driving_board", "arm_board"]
    watched.sent.clear()
    watched.deadman.end(20)
    assert (watched.sent, watched.deadman.next_due) == ([], None)

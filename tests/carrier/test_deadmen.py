"""Deadmen give the same answers as an oracle, and no old command leaves behind a brake."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import re
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from struct import Struct
from typing import cast
from weakref import WeakKeyDictionary

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from router import declared as c
from router.carrier.deadmen import Deadmen, NativeDeadman, successors
from router.carrier.ring import Ring
from router.carrier.sender import NativeSender
from router.clock import boottime_ns
from router.compiler.compiled_table import DeadmanPlan
from router.compiler.metrics import Counters
from router.image.names import Names
from router.image.openings import feed_of
from tests.carrier.building import MEMORY, RACES, run_program
from tests.carrier.opening import opened_deadman
from tests.oracles import deadman as oracle
from tests.oracles.deadman import GREETING, START, START_AGAIN, Event
from tests.readable import readable

NEVER = (1 << 63) - 1
STALE = -1
MS = 1_000_000
EVENT = Struct("@IIIIiI")
TRIPPED, RELEASED, ERROR = 1, 2, 3
PAYLOADS = {"wheels": (b"brake",), "arm": (b"hold", b"stay"), "mast": (b"fold\0\0", b"", b"fold")}
PLAN = DeadmanPlan("drive", 500, 100, (("wheels", PAYLOADS["wheels"]), ("arm", PAYLOADS["arm"])))


class Outlet:
    """An endpoint in memory, which has the address of its `struct sender` as a NativeSender has."""

    def __init__(self, library: ctypes.CDLL, stack: ExitStack) -> None:
        pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._near, self._far = [stack.enter_context(each) for each in pair]
        self._near.setblocking(False)
        self._far.setblocking(False)
        self._intact = stack.enter_context(self._near.dup())
        self._broken = os.open(os.devnull, os.O_WRONLY)
        stack.callback(os.close, self._broken)
        self.address: int = library.sender_open(self._near.fileno(), -1, 1, 1)
        stack.callback(library.sender_close, self.address)

    def breaks(self, *, is_broken: bool) -> None:
        """From now on sending fails with ENOTSOCK, or succeeds."""
        os.dup2(self._broken if is_broken else self._intact.fileno(), self._near.fileno(), inheritable=False)

    def take(self) -> list[bytes]:
        """Return what was sent since the last call."""
        taken = []
        with suppress(BlockingIOError):
            while True:
                taken.append(self._far.recv(100))
        return taken


def senders(outlets: Mapping[str, Outlet]) -> Mapping[str, NativeSender]:
    return cast("Mapping[str, NativeSender]", outlets)


class StaleError(Exception):
    """A command is older than it may be, and was not sent."""


class NativeSide:
    """Deadmen of the carrier, on a clock that is told to go."""

    def __init__(
        self,
        library: ctypes.CDLL,
        seams: ctypes.CDLL,
        stack: ExitStack,
        counters: Counters,
        event_bytes: int = 1 << 14,
    ) -> None:
        self._library = library
        self._seams = seams
        self.counts = (ctypes.c_int64 * 100)()
        self._counters = counters
        self._outlets = {endpoint: Outlet(library, stack) for endpoint in PAYLOADS}
        self._names = Names()
        self._plans: WeakKeyDictionary[NativeDeadman, DeadmanPlan] = WeakKeyDictionary()
        self._ring = Ring(library, event_bytes)
        self.deadmen = Deadmen(library, self.counts, self._ring)
        self._heard = (ctypes.c_int64 * 100)()
        seams.seam_hear(self.deadmen.address, self._heard)

    def add(self, plan: DeadmanPlan) -> NativeDeadman:
        made = opened_deadman(
            self._library, self.deadmen.address, plan, self._counters, self._names, senders(self._outlets)
        )
        self._plans[made] = plan
        return made

    def replace(self, later: NativeDeadman, earlier: NativeDeadman) -> None:
        later.replace(earlier)
        self._library.deadman_replace(self.deadmen.address, later.address, earlier.address)

    def remove(self, deadman: NativeDeadman) -> None:
        deadman.end()

    def command(self, now: int, feeds: list[tuple[NativeDeadman, bool]], data: bytes, endpoint: str = "wheels") -> None:
        array = self._feeds(feeds, endpoint)
        to, deadmen = self._outlets[endpoint].address, self.deadmen.address
        self._library.command_send_at(deadmen, to, data, len(data), NEVER, array, len(feeds), now)

    def _feeds(self, feeds: Sequence[tuple[NativeDeadman, bool]], endpoint: str) -> ctypes.Array[c.Feed]:
        made = [feed_of(self._plans[each], each.address, endpoint, disarms=disarms) for each, disarms in feeds]
        return (c.Feed * len(feeds))(*made)

    def commander(
        self, outlet: Outlet, feeds: Sequence[tuple[NativeDeadman, bool]]
    ) -> Callable[[bytes, int | None], int]:
        """Return what sends a command that may expire, and returns its size. True: the deadman is disarmed."""
        array = self._feeds(feeds, "wheels")
        send, deadmen, to = self._library.command_send, self.deadmen.address, outlet.address

        def command(data: bytes, expires: int | None) -> int:
            error = send(deadmen, to, data, len(data), NEVER if expires is None else expires, array, len(feeds))
            if error == STALE:
                raise StaleError
            if error:
                raise OSError(error, os.strerror(error))
            return len(data)

        return command

    def serve(self, now: int) -> None:
        self._library.timers_serve(self.deadmen.address, now)

    def breaks(self, endpoint: str, *, is_broken: bool) -> None:
        self._outlets[endpoint].breaks(is_broken=is_broken)

    def refuses(self, endpoint: str) -> None:
        self._seams.seam_refuse(self._outlets[endpoint].address, errno.ECONNREFUSED)

    def hears(self, endpoint: str) -> None:
        self._heard[self._counters.index("endpoint_silence_seconds", endpoint)] += 1

    def await_subscribers(self, deadman: NativeDeadman, now: int) -> None:
        self._library.deadman_await_subscribers(self.deadmen.address, deadman.address, now)

    def greet(self, deadman: NativeDeadman, now: int) -> bool:
        return bool(self._library.deadman_greet(self.deadmen.address, deadman.address, now))

    def end_when_served(self, deadman: NativeDeadman) -> None:
        self._library.deadman_end_by_thread(self.deadmen.address, deadman.address)

    def events(self) -> list[Event]:
        name, events = self._names.name, []
        for _, kind, route, target, error, _ in EVENT.iter_unpack(self._ring.take()):
            what = {TRIPPED: "tripped", RELEASED: "released", ERROR: "error"}[kind]
            events.append((what, name(route), name(target) if kind == ERROR else "", error))
        return events

    @property
    def next_due(self) -> int:
        return int(self._seams.seam_next_due(self.deadmen.address))

    @property
    def wakes_at(self) -> int:
        return int(self._seams.seam_wakes_at(self.deadmen.address))

    def taken(self) -> list[tuple[str, bytes]]:
        """What was sent since the last call, by endpoint."""
        return [(endpoint, data) for endpoint, outlet in self._outlets.items() for data in outlet.take()]


plans = st.builds(
    lambda timeout, repeat, endpoints, at_start, following: (timeout, repeat, sorted(endpoints), at_start, following),
    st.integers(1, 50),
    st.integers(1, 20),
    st.sets(st.sampled_from(list(PAYLOADS)), min_size=1),
    st.booleans(),
    st.integers(0, 2),
)
routes = st.sampled_from(["drive", "stop"])
endpoints = st.sampled_from(list(PAYLOADS))
chosen = st.tuples(routes, st.integers(0, 3))
pauses = st.integers(0, 80) | st.sampled_from([GREETING, START_AGAIN - 1, START_AGAIN, START])
steps = st.one_of(
    st.tuples(
        st.just("command"),
        st.tuples(endpoints, st.lists(st.tuples(routes, st.booleans(), st.integers(0, 3)), max_size=3)),
    ),
    st.tuples(st.just("command"), st.tuples(endpoints, st.just([("drive", False, 0)]))),
    st.tuples(st.just("pass"), st.integers(0, 80)),
    st.tuples(st.just("pass"), pauses),
    st.tuples(st.just("replace"), st.tuples(routes, plans)),
    st.tuples(st.just("remove"), chosen),
    st.tuples(st.just("start"), routes),
    st.tuples(st.just("await_subscribers"), chosen),
    st.tuples(st.just("greet"), chosen),
    st.tuples(st.just("end"), chosen),
    st.tuples(st.just("end_when_served"), chosen),
    st.tuples(st.just("break"), st.tuples(endpoints, st.booleans())),
    st.tuples(st.just("refuse"), endpoints),
    st.tuples(st.just("hear"), endpoints),
)

Plan = tuple[int, int, list[str], bool, int]
"""Timeout, repeat, endpoints, whether it sends at the start, how many of its later endpoints are never commanded."""
Pair = tuple[oracle.Deadman, NativeDeadman]


class Comparison:
    """Has both sides take the same steps. Deadmen are chosen by route and age: the last one of a route acts."""

    def __init__(self, library: ctypes.CDLL, seams: ctypes.CDLL, stack: ExitStack) -> None:
        self._counters = Counters()
        self._plain = oracle.Deadmen()
        self._native = NativeSide(library, seams, stack, self._counters)
        self._now = 0
        self._routes: dict[str, list[Pair]] = {"drive": [], "stop": []}
        self._add("drive", (50, 10, ["wheels", "arm"], True, 0))
        self._add("stop", (20, 20, ["wheels"], True, 0))
        for route in self._routes:
            self.do_await_subscribers((route, 0))

    def _add(self, route: str, plan: Plan) -> Pair:
        timeout, repeat, endpoints, at_start, following = plan
        datagrams = tuple((each, PAYLOADS[each]) for each in endpoints)
        made = DeadmanPlan(route, timeout, repeat, datagrams, at_start, frozenset(endpoints[1:][:following]))
        pair = self._plain.add(made), self._native.add(made)
        self._routes[route].append(pair)
        return pair

    def _chosen(self, route: str, age: int) -> Pair:
        deadmen = self._routes[route]
        return deadmen[-1 - age % len(deadmen)]

    def step(self, what: str, arguments: object) -> None:
        getattr(self, f"do_{what}")(arguments)
        sent, self._plain.sent = self._plain.sent, []
        events, self._plain.events = self._plain.events, []
        assert self._native.taken() == sorted(sent, key=lambda each: [*PAYLOADS].index(each[0]))
        assert self._native.events() == events
        assert self._native.next_due == (NEVER if self._plain.next_due is None else self._plain.next_due)
        assert self._native.wakes_at <= self._native.next_due
        for (metric, *labels), count in self._plain.counts.items():
            index = self._counters.index(f"deadman_{metric}", *labels)
            assert self._native.counts[index] == count
        assert sum(self._native.counts) == sum(self._plain.counts.values())

    def do_command(self, arguments: tuple[str, list[tuple[str, bool, int]]]) -> None:
        endpoint, feeds = arguments
        chosen = [(*self._chosen(route, age), disarms) for route, disarms, age in feeds]
        data = b"command %d" % self._now
        self._plain.command(self._now, [(plain, disarms) for plain, _, disarms in chosen], endpoint, data)
        self._native.command(self._now, [(native, disarms) for _, native, disarms in chosen], data, endpoint)

    def do_pass(self, time: int) -> None:
        self._now += time
        self._plain.serve(self._now)
        self._native.serve(self._now)

    def do_replace(self, arguments: tuple[str, Plan]) -> None:
        route, plan = arguments
        (plain, native), (next_plain, next_native) = self._chosen(route, 0), self._add(route, plan)
        self._plain.replace(next_plain, plain)
        self._native.replace(next_native, native)

    def do_remove(self, arguments: tuple[str, int]) -> None:
        """As when an earlier program is retired."""
        route, age = arguments
        plain, native = chosen = self._chosen(route, age)
        if chosen == self._chosen(route, 0):
            return
        self._routes[route].remove(chosen)
        self._plain.end(plain)
        self._plain.remove(plain)
        self._native.remove(native)

    def do_start(self, route: str) -> None:
        plain, native = self._chosen(route, 0)  # one that was replaced has fewer destinations than its plan
        assert native.start(self._now) == self._plain.start(plain, self._now)

    def do_await_subscribers(self, arguments: tuple[str, int]) -> None:
        plain, native = self._chosen(*arguments)
        self._plain.await_subscribers(plain, self._now)
        self._native.await_subscribers(native, self._now)

    def do_greet(self, arguments: tuple[str, int]) -> None:
        plain, native = self._chosen(*arguments)
        assert self._native.greet(native, self._now) == self._plain.greet(plain, self._now)

    def do_end(self, arguments: tuple[str, int]) -> None:
        plain, native = self._chosen(*arguments)
        self._plain.end(plain)
        native.end()

    def do_end_when_served(self, arguments: tuple[str, int]) -> None:
        plain, native = self._chosen(*arguments)
        self._plain.end_when_served(plain)
        self._native.end_when_served(native)

    def do_break(self, arguments: tuple[str, bool]) -> None:
        endpoint, is_broken = arguments
        (self._plain.broken.add if is_broken else self._plain.broken.discard)(endpoint)
        self._native.breaks(endpoint, is_broken=is_broken)

    def do_refuse(self, endpoint: str) -> None:
        self._plain.refused.add(endpoint)
        self._native.refuses(endpoint)

    def do_hear(self, endpoint: str) -> None:
        self._plain.heard[endpoint] += 1
        self._native.hears(endpoint)


@example(
    steps=[
        ("start", "drive"),
        ("hear", "wheels"),
        ("pass", START_AGAIN),
        ("command", ("wheels", [("drive", False, 0)])),
        ("pass", START_AGAIN),
        ("hear", "arm"),
        ("pass", START_AGAIN),
        ("pass", START_AGAIN),
    ]
)
@example(
    steps=[
        ("start", "drive"),
        ("hear", "arm"),
        ("replace", ("drive", (50, 10, ["arm", "mast"], True, 0))),
        ("pass", START_AGAIN),
        ("pass", START_AGAIN),
    ]
)
@example(
    steps=[
        ("greet", ("stop", 0)),
        ("replace", ("stop", (20, 20, ["wheels"], True, 0))),
        ("pass", 1),
        ("pass", GREETING),
    ]
)
@example(steps=[("replace", ("stop", (20, 20, ["wheels"], False, 0))), ("greet", ("stop", 0))])
@given(steps=st.lists(steps, max_size=60))
def test_they_give_the_same_answers(library: ctypes.CDLL, seams: ctypes.CDLL, steps: list[tuple[str, object]]) -> None:
    with ExitStack() as stack:
        comparison = Comparison(library, seams, stack)
        for what, arguments in steps:
            comparison.step(what, arguments)


# what Python calls


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def side(library: ctypes.CDLL, seams: ctypes.CDLL, stack: ExitStack) -> NativeSide:
    return NativeSide(library, seams, stack, Counters())


@pytest.fixture
def outlet(library: ctypes.CDLL, stack: ExitStack) -> Outlet:
    return Outlet(library, stack)


def open_plan(timeout: int = PLAN.timeout, repeat: int = PLAN.repeat, *, at_start: bool = True) -> DeadmanPlan:
    return DeadmanPlan("drive", timeout, repeat, PLAN.datagrams, at_start)


def test_a_command_is_sent_or_an_error_says_why(side: NativeSide, outlet: Outlet) -> None:
    deadman = side.add(PLAN)
    for feeds in ([], [(deadman, False)]):
        command = side.commander(outlet, feeds)
        assert command(b"dr\0ve", None) == 5
        assert command(b"drive", boottime_ns() + 60_000 * MS) == 5
        with pytest.raises(StaleError):
            command(b"too late", boottime_ns() - 1)
        outlet.breaks(is_broken=True)
        with pytest.raises(OSError, match=os.strerror(errno.ENOTSOCK)):
            command(b"lost", None)
        outlet.breaks(is_broken=False)
        assert outlet.take() == [b"dr\0ve", b"drive"]


def test_a_stale_command_feeds_nothing(side: NativeSide, outlet: Outlet) -> None:
    command = side.commander(outlet, [(side.add(PLAN), False)])
    with pytest.raises(StaleError):
        command(b"too late", boottime_ns() - 1)
    assert side.next_due == NEVER


def test_at_the_start_it_says_whom_it_reached(side: NativeSide) -> None:
    side.breaks("arm", is_broken=True)
    assert side.add(open_plan()).start(0) == ["wheels"]
    assert side.add(open_plan(at_start=False)).start(0) == []
    assert side.events() == [("error", "drive", "arm", errno.ENOTSOCK)] * 2


def test_a_command_that_waits_for_the_lock_until_it_is_stale_is_not_sent(
    side: NativeSide, outlet: Outlet, seams: ctypes.CDLL
) -> None:
    command = side.commander(outlet, [(side.add(PLAN), False)])
    expires = boottime_ns() + 50 * MS
    outcome: list[object] = []

    def send() -> None:
        try:
            outcome.append(command(b"old", expires))
        except StaleError:
            outcome.append("stale")

    seams.seam_lock(side.deadmen.address)
    thread = threading.Thread(target=send)
    thread.start()
    while boottime_ns() <= expires:
        pass
    seams.seam_unlock(side.deadmen.address)
    thread.join()
    assert (outcome, outlet.take()) == (["stale"], [])


def test_one_that_was_replaced_keeps_its_successors_alive(side: NativeSide) -> None:
    first, second, third = (side.add(open_plan()) for _ in range(3))
    side.replace(second, first)
    side.replace(third, second)
    alive = [weakref.ref(each) for each in (second, third)]
    del second, third
    gc.collect()
    assert all(each() for each in alive)
    side.command(0, [(first, False)], b"drive")
    assert side.next_due == PLAN.timeout
    del first
    gc.collect()
    assert not any(each() for each in alive)
    side.serve(10**12)
    assert side.next_due == NEVER


def watching(route: str, *sources: str) -> tuple[str, list[str], list[tuple[str, str]]]:
    return route, [], [(source, "drive") for source in sources]


@pytest.mark.parametrize(
    ("before", "now", "routes"),
    [
        ([("a", "1")], [("a", "1")], {"a": "a"}),
        ([("drive", "1")], [("drive_from_1", "1"), ("drive_from_2", "2")], {"drive": "drive_from_1"}),
        ([("from_1", "1"), ("from_2", "2")], [("drive", "2")], {"from_2": "drive"}),
        ([("ros", "1"), ("ros_2", "2")], [("ros", "2"), ("ros_2", "1")], {"ros": "ros_2", "ros_2": "ros"}),
        ([("ros", "1"), ("ros_2", "2")], [("ros", "2")], {"ros_2": "ros"}),
        ([("from_1", "1"), ("from_2", "2")], [("drive", "1", "2")], {"from_1": "drive", "from_2": "drive"}),
        ([("drive", "1", "2", "3")], [("from_1", "1"), ("from_2", "2", "3")], {"drive": "from_2"}),
        ([("drive", "1")], [("drive", "2")], {"drive": "drive"}),
        ([("drive", "1")], [], {}),
    ],
)
def test_a_deadman_replaces_the_one_that_watched_the_same_commands(
    before: list[tuple[str, ...]], now: list[tuple[str, ...]], routes: dict[str, str]
) -> None:
    assert successors([watching(*each) for each in now], [watching(*each) for each in before]) == routes


def test_one_deadman_may_replace_several(side: NativeSide) -> None:
    """It trips when the last of them would, and brakes what is armed in any of them."""
    of_wheels, of_arm, both = side.add(open_plan(timeout=400)), side.add(open_plan()), side.add(open_plan())
    side.command(100, [(of_wheels, False)], b"drive", "wheels")
    side.command(0, [(of_arm, False)], b"lift", "arm")
    side.taken()
    side.replace(both, of_wheels)
    side.replace(both, of_arm)
    assert side.next_due == 600
    side.serve(600)
    assert side.taken() == [("wheels", b"brake"), ("arm", b"hold"), ("arm", b"stay")]
    side.command(650, [(of_arm, True)], b"lift", "arm")  # of a thread that has not changed to the next program
    side.serve(700)
    assert side.taken() == [("wheels", b"brake"), ("arm", b"lift")]
    side.command(750, [(of_wheels, True)], b"drive", "wheels")
    assert (side.next_due, side.events()[-1][0]) == (NEVER, "released")


def test_what_a_command_feeds_lives_as_long_as_the_command(side: NativeSide, outlet: Outlet) -> None:
    command = side.commander(outlet, [(side.add(open_plan(timeout=1)), False)])
    gc.collect()
    command(b"drive", None)
    side.serve(boottime_ns() + MS)
    assert ("tripped", "drive", "", 0) in side.events()


def test_commands_leave_the_timer_alone_and_it_wakes_whoever_waits(
    side: NativeSide, outlet: Outlet, seams: ctypes.CDLL
) -> None:
    command = side.commander(outlet, [(side.add(open_plan(20 * MS)), False)])
    command(b"drive", None)
    wakes_at = side.wakes_at
    for _ in range(100):
        command(b"drive", None)
        assert side.wakes_at == wakes_at
    due = side.next_due
    assert due > wakes_at
    timer = seams.seam_timer(side.deadmen.address)
    tripped = False
    while not tripped:
        assert readable(timer, 10)
        now = boottime_ns()
        side.serve(now)
        tripped = ("tripped", "drive", "", 0) in side.events()
        assert tripped == (now >= due)
    assert side.wakes_at == side.next_due


def test_a_command_costs_the_same_however_many_deadmen_there_are(side: NativeSide, seams: ctypes.CDLL) -> None:
    """Sending it looks at no other deadman, nor does replacing its deadman and removing the earlier one."""
    deadmen = [side.add(open_plan(timeout=500 + index)) for index in range(1000)]
    later = side.add(open_plan(timeout=400))
    for now, deadman in enumerate(deadmen):
        side.command(now, [(deadman, False)], b"drive")
    seams.seam_hide(side.deadmen.address, True)
    try:
        side.command(1000, [(deadmen[-1], False), (deadmen[0], True)], b"drive")
        side.replace(later, deadmen[-1])
        side.command(1001, [(later, False)], b"drive")
    finally:
        seams.seam_hide(side.deadmen.address, False)
    assert side.wakes_at == 500
    side.serve(500)
    assert side.wakes_at == side.next_due == 502


def test_the_timer_is_set_for_an_earlier_deadline(side: NativeSide) -> None:
    slow, fast = side.add(open_plan(timeout=900)), side.add(open_plan(timeout=100))
    seen = []
    for deadman in (slow, fast, slow):
        side.command(0, [(deadman, False)], b"drive")
        seen.append(side.wakes_at)
    assert seen == [900, 100, 100]


def test_without_room_for_events_the_oldest_are_dropped(
    library: ctypes.CDLL, seams: ctypes.CDLL, stack: ExitStack
) -> None:
    side = NativeSide(library, seams, stack, Counters(), event_bytes=64)
    deadman = side.add(PLAN)
    for now in range(0, 10 * PLAN.timeout, 2 * PLAN.timeout):
        side.command(now, [(deadman, False)], b"drive")
        side.serve(now + PLAN.timeout)
    assert side.events() == [("released", "drive", "", 0), ("tripped", "drive", "", 0)]


# under real threads


@pytest.mark.parametrize(
    "sanitizers",
    [
        "",
        pytest.param(RACES, marks=pytest.mark.slow),
        pytest.param(MEMORY, marks=pytest.mark.slow),
    ],
)
def test_no_old_command_leaves_behind_a_brake(tmp_path: Path, sanitizers: str) -> None:
    run_program("brakes", tmp_path, 3000 if sanitizers else 1000, sanitizers=sanitizers)


def test_the_timer_counts_a_suspend(side: NativeSide, seams: ctypes.CDLL) -> None:
    info = Path(f"/proc/self/fdinfo/{seams.seam_timer(side.deadmen.address)}").read_text()
    assert re.findall(r"^clockid: (\d+)$", info, re.MULTILINE) == [str(time.CLOCK_BOOTTIME)]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes namespaces")
def test_ages_and_deadlines_are_of_the_clock_that_counts_a_suspend() -> None:
    """Where that clock is ahead of the monotonic one, as it is after a suspend: nobody may suspend the machine here."""
    tests = (
        test_a_command_is_sent_or_an_error_says_why.__name__,
        test_a_stale_command_feeds_nothing.__name__,
        test_commands_leave_the_timer_alone_and_it_wakes_whoever_waits.__name__,
    )
    pytest_alone = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    chosen = [f"{__file__}::{name}" for name in tests]
    command = ["unshare", "--time", "--boottime", "100000", *pytest_alone, *chosen]
    subprocess.run(command, check=True)

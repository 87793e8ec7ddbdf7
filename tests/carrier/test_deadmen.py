"""The carrier's deadmen give the same answers as those of Python, and no old command leaves behind a brake."""

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
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from struct import Struct
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.carrier import structures as c
from router.carrier.deadmen import Deadmen, NativeDeadman
from router.carrier.outlets import Names
from router.carrier.ring import Ring
from router.carrier.sender import NativeSender
from router.clock import boottime_ns
from router.compiler.metrics import Counters
from router.compiler.program import DeadmanPlan
from router.engine.deadman import Deadman
from router.engine.delivery import Report, Stale
from tests.carrier.building import MEMORY, RACES, run_program
from tests.readable import readable

NEVER = (1 << 63) - 1
MS = 1_000_000
EVENT = Struct("@IIIIiI")
TRIPPED, RELEASED, ERROR = 1, 2, 3
PAYLOADS = {"wheels": b"brake", "arm": b"hold", "mast": b"fold\0\0"}
PLAN = DeadmanPlan("drive", 500, 100, (("wheels", b"brake"), ("arm", b"hold")))

Event = tuple[str, str, str, int]
"""What happened, to the deadman of which route, and at which endpoint, with which errno."""


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
        self.address: int = library.sender_open(self._near.fileno(), -1, 0, 0)
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


class PythonSide:
    """Deadmen of Python, with all that comes out of them."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.counts = [0] * 100
        self._sent: dict[str, list[bytes]] = {endpoint: [] for endpoint in PAYLOADS}
        self._broken: set[str] = set()
        self._events: list[Event] = []
        self._deadmen: list[Deadman] = []
        self._send = {endpoint: self._sender(endpoint) for endpoint in PAYLOADS}

    def _sender(self, endpoint: str) -> Callable[[bytes], int]:
        def send(data: bytes) -> int:
            if endpoint in self._broken:
                raise OSError(errno.ENOTSOCK, "")
            self._sent[endpoint].append(data)
            return len(data)

        return send

    def _report(self, report: Report) -> None:
        assert isinstance(report.error, OSError)
        self._events.append(("error", report.place, report.target, report.error.errno or 0))

    def _changed(self, route: str, is_active: bool) -> None:
        self._events.append(("tripped" if is_active else "released", route, "", 0))

    def add(self, plan: DeadmanPlan) -> Deadman:
        deadman = Deadman(plan, self.counters, self.counts, self._send, self._report, self._changed)
        self._deadmen.append(deadman)
        return deadman

    def replace(self, later: Deadman, earlier: Deadman) -> None:
        later.replace(earlier)

    def remove(self, deadman: Deadman) -> None:
        deadman.end(0)
        self._deadmen.remove(deadman)

    def command(self, now: int, feeds: list[tuple[Deadman, bool]], data: bytes) -> None:
        with suppress(OSError):
            self._send["wheels"](data)
            for deadman, disarms in feeds:
                (deadman.disarm if disarms else deadman.feed)(now)

    def serve(self, now: int) -> None:
        for deadman in reversed(self._deadmen):
            deadman.due(now)

    def breaks(self, endpoint: str, *, is_broken: bool) -> None:
        (self._broken.add if is_broken else self._broken.discard)(endpoint)

    def seen(self) -> object:
        due = min((each.next_due for each in self._deadmen if each.next_due is not None), default=NEVER)
        sent = {endpoint: list(taken) for endpoint, taken in self._sent.items()}
        for taken in self._sent.values():
            taken.clear()
        events, self._events = self._events, []
        return sent, events, min(due, NEVER), self.counts


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
        self._ring = Ring(library, event_bytes)
        self.deadmen = Deadmen(library, self.counts, self._ring, self._names)

    def add(self, plan: DeadmanPlan) -> NativeDeadman:
        return self.deadmen.add(plan, self._counters, senders(self._outlets))

    def replace(self, later: NativeDeadman, earlier: NativeDeadman) -> None:
        later.succeeds(earlier)
        self._library.deadman_replace(self.deadmen.address, later.address, earlier.address)

    def remove(self, deadman: NativeDeadman) -> None:
        deadman.end()

    def command(self, now: int, feeds: list[tuple[NativeDeadman, bool]], data: bytes) -> None:
        array = (c.Feed * len(feeds))(*(c.Feed(deadman.address, disarms) for deadman, disarms in feeds))
        to, deadmen = self._outlets["wheels"].address, self.deadmen.address
        self._library.command_send_at(deadmen, to, data, len(data), NEVER, array, len(feeds), now)

    def serve(self, now: int) -> None:
        self._library.timers_serve(self.deadmen.address, now)

    def breaks(self, endpoint: str, *, is_broken: bool) -> None:
        self._outlets[endpoint].breaks(is_broken=is_broken)

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
    def timer_set_for(self) -> int:
        return int(self._seams.seam_timer_set_for(self.deadmen.address))

    def seen(self) -> object:
        due = self.next_due
        assert self.timer_set_for <= due
        sent = {endpoint: outlet.take() for endpoint, outlet in self._outlets.items()}
        return sent, self.events(), due, list(self.counts)


plans = st.builds(
    lambda timeout, repeat, endpoints: (timeout, repeat, sorted(endpoints)),
    st.integers(1, 50),
    st.integers(1, 20),
    st.sets(st.sampled_from(list(PAYLOADS))),
)
routes = st.sampled_from(["drive", "stop"])
steps = st.one_of(
    st.tuples(st.just("command"), st.lists(st.tuples(routes, st.booleans(), st.integers(0, 3)), max_size=3)),
    st.tuples(st.just("command"), st.just([("drive", False, 0)])),
    st.tuples(st.just("pass"), st.integers(0, 80)),
    st.tuples(st.just("pass"), st.integers(0, 80)),
    st.tuples(st.just("replace"), st.tuples(routes, plans)),
    st.tuples(st.just("remove"), st.tuples(routes, st.integers(0, 3))),
    st.tuples(st.just("start"), st.tuples(routes, st.integers(0, 3))),
    st.tuples(st.just("end"), st.tuples(routes, st.integers(0, 3))),
    st.tuples(st.just("break"), st.tuples(st.sampled_from(list(PAYLOADS)), st.booleans())),
)


class Comparison:
    """Has both sides take the same steps. Deadmen are chosen by route and age: the last one of a route acts."""

    def __init__(self, library: ctypes.CDLL, seams: ctypes.CDLL, stack: ExitStack) -> None:
        self._python = PythonSide()
        self._native = NativeSide(library, seams, stack, self._python.counters)
        self._now = 0
        self._routes: dict[str, list[tuple[Deadman, NativeDeadman]]] = {"drive": [], "stop": []}
        self._add("drive", (50, 10, ["wheels", "arm"]))
        self._add("stop", (20, 20, ["wheels"]))

    def _add(self, route: str, plan: tuple[int, int, list[str]]) -> tuple[Deadman, NativeDeadman]:
        timeout, repeat, endpoints = plan
        made = DeadmanPlan(route, timeout, repeat, tuple((each, PAYLOADS[each]) for each in endpoints))
        pair = self._python.add(made), self._native.add(made)
        self._routes[route].append(pair)
        return pair

    def _chosen(self, route: str, age: int) -> tuple[Deadman, NativeDeadman]:
        deadmen = self._routes[route]
        return deadmen[-1 - age % len(deadmen)]

    def step(self, what: str, arguments: object) -> None:
        getattr(self, f"do_{what}")(arguments)
        assert self._native.seen() == self._python.seen()

    def do_command(self, feeds: list[tuple[str, bool, int]]) -> None:
        chosen = [(*self._chosen(route, age), disarms) for route, disarms, age in feeds]
        data = b"command %d" % self._now
        self._python.command(self._now, [(python, disarms) for python, _, disarms in chosen], data)
        self._native.command(self._now, [(native, disarms) for _, native, disarms in chosen], data)

    def do_pass(self, time: int) -> None:
        self._now += time
        self._python.serve(self._now)
        self._native.serve(self._now)

    def do_replace(self, arguments: tuple[str, tuple[int, int, list[str]]]) -> None:
        route, plan = arguments
        (python, native), (next_python, next_native) = self._chosen(route, 0), self._add(route, plan)
        self._python.replace(next_python, python)
        self._native.replace(next_native, native)

    def do_remove(self, arguments: tuple[str, int]) -> None:
        """As when an earlier program is retired."""
        route, age = arguments
        python, native = chosen = self._chosen(route, age)
        if chosen == self._chosen(route, 0):
            return
        self._routes[route].remove(chosen)
        self._python.remove(python)
        self._native.remove(native)

    def do_start(self, arguments: tuple[str, int]) -> None:
        python, native = self._chosen(*arguments)
        if arguments[1] == 0:  # one that was replaced has fewer destinations than its plan
            assert native.start(self._now) == python.start(self._now)

    def do_end(self, arguments: tuple[str, int]) -> None:
        python, native = self._chosen(*arguments)
        python.end(self._now)
        native.end()

    def do_break(self, arguments: tuple[str, bool]) -> None:
        endpoint, is_broken = arguments
        self._python.breaks(endpoint, is_broken=is_broken)
        self._native.breaks(endpoint, is_broken=is_broken)


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


def test_a_command_is_sent_or_raises_what_python_would(side: NativeSide, outlet: Outlet) -> None:
    deadman = side.add(PLAN)
    for feeds in ([], [(deadman, False)]):
        command = side.deadmen.command(cast("NativeSender", outlet), feeds)
        assert command(b"dr\0ve", None) == 5
        assert command(b"drive", boottime_ns() + 60_000 * MS) == 5
        with pytest.raises(Stale):
            command(b"too late", boottime_ns() - 1)
        outlet.breaks(is_broken=True)
        with pytest.raises(OSError, match=os.strerror(errno.ENOTSOCK)):
            command(b"lost", None)
        outlet.breaks(is_broken=False)
        assert outlet.take() == [b"dr\0ve", b"drive"]


def test_a_stale_command_feeds_nothing(side: NativeSide, outlet: Outlet) -> None:
    command = side.deadmen.command(cast("NativeSender", outlet), [(side.add(PLAN), False)])
    with pytest.raises(Stale):
        command(b"too late", boottime_ns() - 1)
    assert side.next_due == NEVER


def test_at_the_start_it_says_whom_it_reached(side: NativeSide) -> None:
    side.breaks("arm", is_broken=True)
    assert side.add(open_plan()).start(0) == ["wheels"]
    assert side.add(open_plan(at_start=False)).start(0) == []
    assert side.events() == [("error", "drive", "arm", errno.ENOTSOCK)]


def test_a_command_that_waits_for_the_lock_until_it_is_stale_is_not_sent(
    side: NativeSide, outlet: Outlet, seams: ctypes.CDLL
) -> None:
    command = side.deadmen.command(cast("NativeSender", outlet), [(side.add(PLAN), False)])
    expires = boottime_ns() + 50 * MS
    outcome: list[object] = []

    def send() -> None:
        try:
            outcome.append(command(b"old", expires))
        except Stale:
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


def test_what_a_command_feeds_lives_as_long_as_the_command(side: NativeSide, outlet: Outlet) -> None:
    command = side.deadmen.command(cast("NativeSender", outlet), [(side.add(open_plan(timeout=1)), False)])
    gc.collect()
    command(b"drive", None)
    side.serve(boottime_ns() + MS)
    assert ("tripped", "drive", "", 0) in side.events()


def test_commands_leave_the_timer_alone_and_it_wakes_whoever_waits(
    side: NativeSide, outlet: Outlet, seams: ctypes.CDLL
) -> None:
    command = side.deadmen.command(cast("NativeSender", outlet), [(side.add(open_plan(20 * MS)), False)])
    command(b"drive", None)
    set_for = side.timer_set_for
    for _ in range(100):
        command(b"drive", None)
        assert side.timer_set_for == set_for
    due = side.next_due
    assert due > set_for
    timer = seams.seam_timer(side.deadmen.address)
    tripped = False
    while not tripped:
        assert readable(timer, 10)
        now = boottime_ns()
        side.serve(now)
        tripped = ("tripped", "drive", "", 0) in side.events()
        assert tripped == (now >= due)
    assert side.timer_set_for == side.next_due


def test_the_timer_is_set_for_an_earlier_deadline(side: NativeSide) -> None:
    slow, fast = side.add(open_plan(timeout=900)), side.add(open_plan(timeout=100))
    seen = []
    for deadman in (slow, fast, slow):
        side.command(0, [(deadman, False)], b"drive")
        seen.append(side.timer_set_for)
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
        test_a_command_is_sent_or_raises_what_python_would.__name__,
        test_a_stale_command_feeds_nothing.__name__,
        test_commands_leave_the_timer_alone_and_it_wakes_whoever_waits.__name__,
    )
    pytest_alone = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    chosen = [f"{__file__}::{name}" for name in tests]
    command = ["unshare", "--time", "--boottime", "100000", *pytest_alone, *chosen]
    subprocess.run(command, check=True)

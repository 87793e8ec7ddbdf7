"""The thread that serves machines: what is due is done, in order and one at a time, whatever a machine raises."""

from __future__ import annotations

import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from time import monotonic_ns

import pytest

from router.threads.timekeeper import Timekeeper

MS = 1_000_000
HOUR = 3600 * 1000 * MS
PATIENCE = 10


class Bell:
    """A machine that rings into a queue when it is due, once each time it was set."""

    def __init__(self, rung: queue.SimpleQueue[str], name: str = "bell") -> None:
        self.next_due: int | None = None
        self.name = name
        self.error: Exception | None = None
        self.calls = 0
        self._rung = rung
        self._busy = threading.Lock()

    def ring_at(self, time: int) -> None:
        assert self._busy.acquire(blocking=False), "two calls at once"
        self.next_due = time
        self.calls += 1
        self._busy.release()

    def due(self, now: int) -> None:
        assert self._busy.acquire(blocking=False), "two calls at once"
        assert self.next_due is not None
        assert self.next_due <= now
        self._rung.put(self.name)
        self._busy.release()
        if self.error is not None:
            raise self.error
        self.next_due = None

    def end(self, now: int) -> None:
        self.next_due = None
        self._rung.put(f"{self.name} ends")
        if self.error is not None:
            raise self.error


class Keeping:
    """A running timekeeper and what came of it."""

    def __init__(self, stack: ExitStack) -> None:
        self.rung: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.failures: queue.SimpleQueue[Exception] = queue.SimpleQueue()
        self.keeper = Timekeeper("test", monotonic_ns, self.failures.put)
        self._stack = stack

    def start(self) -> None:
        self.keeper.start()
        self._stack.callback(self.keeper.stop)

    def heard(self) -> str:
        return self.rung.get(timeout=PATIENCE)


@pytest.fixture
def keeping() -> Iterator[Keeping]:
    with ExitStack() as stack:
        yield Keeping(stack)


def test_what_is_due_at_the_start_is_done(keeping: Keeping) -> None:
    bell = Bell(keeping.rung)
    bell.next_due = monotonic_ns()
    keeping.keeper.add(bell)
    keeping.start()
    assert keeping.heard() == "bell"


def test_a_guarded_call_that_brings_something_nearer_wakes_the_thread(keeping: Keeping) -> None:
    bell = Bell(keeping.rung)
    ring_at = keeping.keeper.guard(bell, bell.ring_at)
    ring_at(monotonic_ns() + HOUR)
    keeping.start()
    for _ in range(50):
        ring_at(monotonic_ns() + HOUR)
        ring_at(monotonic_ns())
        assert keeping.heard() == "bell"
    assert keeping.failures.empty()


def test_what_another_machine_is_handed_wakes_the_thread_too(keeping: Keeping) -> None:
    """As with a limit in front of an endpoint's budget."""
    first, second = Bell(keeping.rung, "first"), Bell(keeping.rung, "second")
    keeping.keeper.add(second)
    hand_on = keeping.keeper.guard(first, second.ring_at)
    keeping.start()
    hand_on(monotonic_ns())
    assert keeping.heard() == "second"


def test_what_a_machine_hands_on_when_it_is_due_is_seen_to(keeping: Keeping) -> None:
    """It was added after the one that it hands on to, as whoever wires them up has it at hand by then."""
    second = Bell(keeping.rung, "second")

    class HandsOn(Bell):
        def due(self, now: int) -> None:
            super().due(now)
            second.ring_at(now)

    first = HandsOn(keeping.rung, "first")
    first.next_due = monotonic_ns()
    keeping.keeper.add(second)
    keeping.keeper.add(first)
    keeping.start()
    assert [keeping.heard(), keeping.heard()] == ["first", "second"]


def test_machines_are_served_in_the_order_of_their_times(keeping: Keeping) -> None:
    names = ["third", "first", "second"]
    now = monotonic_ns()
    for name, delay in zip(names, (200, 40, 120), strict=True):
        bell = Bell(keeping.rung, name)
        keeping.keeper.guard(bell, bell.ring_at)(now + delay * MS)
    keeping.start()
    assert [keeping.heard() for _ in names] == ["first", "second", "third"]


def test_nothing_is_done_before_its_time(keeping: Keeping) -> None:
    """The bell checks the time it is told, this the time that has passed."""
    bell = Bell(keeping.rung)
    ring_at = keeping.keeper.guard(bell, bell.ring_at)
    keeping.start()
    for delay in (0, 1, 10, 50):
        time = monotonic_ns() + delay * MS
        ring_at(time)
        keeping.heard()
        assert monotonic_ns() >= time


def test_a_failure_is_handed_over_and_the_other_machines_are_served(keeping: Keeping) -> None:
    broken, sound = Bell(keeping.rung, "broken"), Bell(keeping.rung, "sound")
    broken.error = LookupError("a bug")
    broken.next_due = sound.next_due = monotonic_ns()
    keeping.keeper.add(sound)
    keeping.keeper.add(broken)
    keeping.start()
    assert [keeping.heard(), keeping.heard()] == ["broken", "sound"]
    assert keeping.failures.get(timeout=PATIENCE) is broken.error


def test_a_machine_that_failed_is_tried_again_but_not_all_the_time(keeping: Keeping) -> None:
    broken = Bell(keeping.rung)
    broken.error = LookupError("a bug")
    broken.next_due = begun = monotonic_ns()
    keeping.keeper.add(broken)
    keeping.start()
    for _ in range(3):
        assert isinstance(keeping.failures.get(timeout=PATIENCE), LookupError)
    broken.error = None
    keeping.keeper.stop()
    assert 3 + keeping.failures.qsize() <= 1 + (monotonic_ns() - begun) / (100 * MS)


def test_a_guarded_call_returns_and_raises_what_the_call_does(keeping: Keeping) -> None:
    bell = Bell(keeping.rung)
    keeping.start()
    divided = keeping.keeper.guard(bell, divmod)
    assert divided(7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        divided(7, 0)
    assert divided(4, 2) == (2, 0)


def test_no_two_calls_happen_at_once(keeping: Keeping) -> None:
    bells = [Bell(keeping.rung, name) for name in ("left", "right")]
    ring_at = [keeping.keeper.guard(bell, bell.ring_at) for bell in bells]
    keeping.start()

    def hammer(index: int) -> None:
        for _ in range(2000):
            ring_at[index % 2](monotonic_ns())

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    threads = [threading.Thread(target=hammer, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sys.setswitchinterval(interval)
    assert keeping.failures.empty()
    assert [bell.calls for bell in bells] == [4000, 4000]


@pytest.mark.parametrize("due", [None, HOUR], ids=["nothing due", "something far away"])
def test_stopping_does_not_wait_for_what_is_due_later(keeping: Keeping, due: int | None) -> None:
    bell = Bell(keeping.rung)
    ring_at = keeping.keeper.guard(bell, bell.ring_at)
    keeping.keeper.start()
    if due is not None:
        ring_at(monotonic_ns() + due)
    keeping.keeper.stop()
    ring_at(monotonic_ns())  # can still be called, and nothing comes of it
    assert (keeping.heard(), keeping.rung.empty()) == ("bell ends", True)


@pytest.mark.parametrize("is_started", [False, True])
def test_stopping_ends_all_machines_whatever_one_of_them_raises(keeping: Keeping, is_started: bool) -> None:
    """The last that was added comes first: it may hand on to earlier ones."""
    for name in ("pacer", "broken", "latest"):
        bell = Bell(keeping.rung, name)
        bell.error = LookupError("a bug") if name == "broken" else None
        keeping.keeper.add(bell)
    if is_started:
        keeping.keeper.start()
    keeping.keeper.stop()
    assert [keeping.heard() for _ in range(3)] == ["latest ends", "broken ends", "pacer ends"]
    assert isinstance(keeping.failures.get_nowait(), LookupError)


SET_BACK = """\
#define _GNU_SOURCE
#include <dlfcn.h>
#include <semaphore.h>
#include <time.h>
int sem_clockwait(sem_t *semaphore, clockid_t clock, const struct timespec *until) {
    struct timespec later = {until->tv_sec + 3600, until->tv_nsec};
    return ((int (*)(sem_t *, clockid_t, const struct timespec *))dlsym(RTLD_NEXT, __func__))(semaphore, clock, &later);
}
"""
"""Python's locks as they are where they count by the wall clock, and that is set back by an hour while they wait."""


def test_a_wall_clock_that_is_set_back_delays_nothing(tmp_path: Path) -> None:
    """Nobody may set the clock of the machine for a test, so Python's locks are made to believe it."""
    compiler, library = shutil.which("cc"), tmp_path / "set_back.so"
    assert compiler
    subprocess.run([compiler, "-shared", "-fPIC", "-x", "c", "-", "-o", library], input=SET_BACK, text=True, check=True)
    waits = f"import {__name__} as tests; tests.wait_for_a_bell()"
    environment = {**os.environ, "LD_PRELOAD": str(library), "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", waits], env=environment, timeout=2 * PATIENCE, check=True)


def wait_for_a_bell() -> None:
    """In a process of its own, without queues: they wait as locks do."""
    with ExitStack() as stack:
        keeping = Keeping(stack)
        bell = Bell(keeping.rung)
        bell.next_due = monotonic_ns() + 10 * MS
        keeping.keeper.add(bell)
        keeping.start()
        deadline = monotonic_ns() + PATIENCE * 1000 * MS
        while keeping.rung.empty():
            assert monotonic_ns() < deadline, "it never rang"

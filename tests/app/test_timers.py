"""The threads that serve timers: what is due is done, in order and one at a time, whatever a timer raises."""

from __future__ import annotations

import os
import queue
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from time import CLOCK_BOOTTIME

import pytest

from router.app.timers import TimerThread
from router.clock import boottime_ns
from router.threads import Alarm

MS = 1_000_000
HOUR = 3600 * 1000 * MS
PATIENCE = 10


class Bell:
    """A timer that rings into a queue when it is due, once each time it was set."""

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


class Running:
    """A running timer thread and what came of it."""

    def __init__(self, stack: ExitStack) -> None:
        self.rung: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.failures: queue.SimpleQueue[Exception] = queue.SimpleQueue()
        self.thread = TimerThread("test", self.failures.put)
        self._stack = stack

    def start(self) -> None:
        self.thread.start()
        self._stack.callback(self.thread.stop)

    def heard(self) -> str:
        return self.rung.get(timeout=PATIENCE)


@pytest.fixture
def running() -> Iterator[Running]:
    with ExitStack() as stack:
        yield Running(stack)


def test_what_is_due_at_the_start_is_done(running: Running) -> None:
    bell = Bell(running.rung)
    bell.next_due = boottime_ns()
    running.thread.add(bell)
    running.start()
    assert running.heard() == "bell"


def test_a_timer_is_added_while_another_one_is_stuck(running: Running) -> None:
    is_in, goes_on = threading.Event(), threading.Event()

    class Stuck(Bell):
        def due(self, now: int) -> None:
            is_in.set()
            goes_on.wait(PATIENCE)
            super().due(now)

    stuck, added = Stuck(running.rung, "stuck"), Bell(running.rung)
    running.start()
    running.thread.locked(stuck, stuck.ring_at)(0)
    assert is_in.wait(PATIENCE)
    ring = running.thread.locked(added, added.ring_at)
    assert running.rung.empty()
    goes_on.set()
    assert running.heard() == "stuck"
    ring(0)
    assert running.heard() == "bell"


def test_a_locked_call_that_brings_something_nearer_wakes_the_thread(running: Running) -> None:
    bell = Bell(running.rung)
    ring_at = running.thread.locked(bell, bell.ring_at)
    ring_at(boottime_ns() + HOUR)
    running.start()
    for _ in range(50):
        ring_at(boottime_ns() + HOUR)
        ring_at(boottime_ns())
        assert running.heard() == "bell"
    assert running.failures.empty()


def test_what_another_timer_is_handed_wakes_the_thread_too(running: Running) -> None:
    """As with a limit in front of an endpoint's budget."""
    first, second = Bell(running.rung, "first"), Bell(running.rung, "second")
    running.thread.add(second)
    hand_on = running.thread.locked(first, second.ring_at)
    running.start()
    hand_on(boottime_ns())
    assert running.heard() == "second"


def test_what_a_timer_hands_on_when_it_is_due_is_seen_to(running: Running) -> None:
    """It was added after the one that it hands on to, as whoever wires them up has it at hand by then."""
    second = Bell(running.rung, "second")

    class HandsOn(Bell):
        def due(self, now: int) -> None:
            super().due(now)
            second.ring_at(now)

    first = HandsOn(running.rung, "first")
    first.next_due = boottime_ns()
    running.thread.add(second)
    running.thread.add(first)
    running.start()
    assert [running.heard(), running.heard()] == ["first", "second"]


def test_timers_are_served_in_the_order_of_their_times(running: Running) -> None:
    names = ["third", "first", "second"]
    now = boottime_ns()
    for name, delay in zip(names, (200, 40, 120), strict=True):
        bell = Bell(running.rung, name)
        running.thread.locked(bell, bell.ring_at)(now + delay * MS)
    running.start()
    assert [running.heard() for _ in names] == ["first", "second", "third"]


def test_nothing_is_done_before_its_time(running: Running) -> None:
    """The bell checks the time it is told, this the time that has passed."""
    bell = Bell(running.rung)
    ring_at = running.thread.locked(bell, bell.ring_at)
    running.start()
    for delay in (0, 1, 10, 50):
        time = boottime_ns() + delay * MS
        ring_at(time)
        running.heard()
        assert boottime_ns() >= time


def test_a_failure_is_handed_over_and_the_other_timers_are_served(running: Running) -> None:
    broken, sound = Bell(running.rung, "broken"), Bell(running.rung, "sound")
    broken.error = LookupError("a bug")
    broken.next_due = sound.next_due = boottime_ns()
    running.thread.add(sound)
    running.thread.add(broken)
    running.start()
    assert [running.heard(), running.heard()] == ["broken", "sound"]
    assert running.failures.get(timeout=PATIENCE) is broken.error


def test_a_timer_that_failed_is_tried_again_but_not_all_the_time(running: Running) -> None:
    broken = Bell(running.rung)
    broken.error = LookupError("a bug")
    broken.next_due = begun = boottime_ns()
    running.thread.add(broken)
    running.start()
    for _ in range(3):
        assert isinstance(running.failures.get(timeout=PATIENCE), LookupError)
    broken.error = None
    running.thread.stop()
    assert 3 + running.failures.qsize() <= 1 + (boottime_ns() - begun) / (100 * MS)


def test_a_locked_call_returns_and_raises_what_the_call_does(running: Running) -> None:
    bell = Bell(running.rung)
    running.start()
    divided = running.thread.locked(bell, divmod)
    assert divided(7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        divided(7, 0)
    assert divided(4, 2) == (2, 0)


def test_no_two_calls_happen_at_once(running: Running) -> None:
    bells = [Bell(running.rung, name) for name in ("left", "right")]
    ring_at = [running.thread.locked(bell, bell.ring_at) for bell in bells]
    running.start()

    def hammer(index: int) -> None:
        for _ in range(2000):
            ring_at[index % 2](boottime_ns())

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    threads = [threading.Thread(target=hammer, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sys.setswitchinterval(interval)
    assert running.failures.empty()
    assert [bell.calls for bell in bells] == [4000, 4000]


@pytest.mark.parametrize("due", [None, HOUR], ids=["nothing due", "something far away"])
def test_stopping_does_not_wait_for_what_is_due_later(running: Running, due: int | None) -> None:
    bell = Bell(running.rung)
    ring_at = running.thread.locked(bell, bell.ring_at)
    running.thread.start()
    if due is not None:
        ring_at(boottime_ns() + due)
    running.thread.stop()
    ring_at(boottime_ns())  # can still be called, and nothing comes of it
    assert (running.heard(), running.rung.empty()) == ("bell ends", True)


@pytest.mark.parametrize("is_started", [False, True])
def test_stopping_ends_all_timers_whatever_one_of_them_raises(running: Running, is_started: bool) -> None:
    """The last that was added comes first: it may hand on to earlier ones."""
    for name in ("pacer", "broken", "latest"):
        bell = Bell(running.rung, name)
        bell.error = LookupError("a bug") if name == "broken" else None
        running.thread.add(bell)
    if is_started:
        running.thread.start()
    running.thread.stop()
    assert [running.heard() for _ in range(3)] == ["latest ends", "broken ends", "pacer ends"]
    assert isinstance(running.failures.get_nowait(), LookupError)


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


def test_deadlines_are_of_the_boot_clock_as_after_a_suspend() -> None:
    """Nobody may suspend the machine for a test. In this namespace the boot clock is ahead, as after a suspend."""
    waits = f"import {__name__} as tests; tests.wait_for_a_bell(); tests.show_timers()"
    command = ["unshare", "--time", "--boottime", "100000", sys.executable, "-c", waits]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    if os.geteuid() != 0:
        pytest.skip("only root makes namespaces")
    done = subprocess.run(command, env=environment, timeout=2 * PATIENCE, check=True, capture_output=True, text=True)
    assert done.stdout.split() == [f"{CLOCK_BOOTTIME}"]


def show_timers() -> None:
    """Print the clock of each timer of this process. A suspend does not stop those of CLOCK_BOOTTIME alone."""
    alarm = Alarm()
    for info in Path("/proc/self/fdinfo").iterdir():
        with suppress(FileNotFoundError):  # that of the directory
            print(*re.findall(r"^clockid: (\d+)$", info.read_text(), re.MULTILINE))
    alarm.close()


def wait_for_a_bell() -> None:
    """In a process of its own, without queues: they wait as locks do."""
    with ExitStack() as stack:
        running = Running(stack)
        bell = Bell(running.rung)
        bell.next_due = boottime_ns() + 10 * MS
        running.thread.add(bell)
        running.start()
        deadline = boottime_ns() + PATIENCE * 1000 * MS
        while running.rung.empty():
            assert boottime_ns() < deadline, "it never rang"

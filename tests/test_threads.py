"""Background scheduling, threads that nothing can block, and an exit in spite of stuck threads."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from _thread import start_new_thread
from collections.abc import Callable

import pytest
from structlog.testing import capture_logs

from router import threads
from router.threads import DaemonThread, StopStack, Thread, background_threads, join_or_abandon
from tests.tasks import thread_names

TIMEOUT_S = 20.0


def policy_of_a_new_thread() -> int:
    policies: list[int] = []
    thread = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
    thread.start()
    thread.join()
    return policies[0]


def test_threads_started_inside_are_batch_and_those_after_are_not() -> None:
    with background_threads():
        inside = policy_of_a_new_thread()
    assert (inside, policy_of_a_new_thread()) == (os.SCHED_BATCH, os.SCHED_OTHER)


def test_a_thread_whose_start_failed_needs_no_end() -> None:
    assert join_or_abandon(Thread(lambda: None, "test"))


def test_the_kernel_knows_the_name_of_a_thread() -> None:
    names: list[str] = []
    thread = Thread(lambda: names.extend(thread_names()), "a very long name")
    thread.start()
    thread.join()
    assert "a very long nam" in names


def test_the_policy_returns_after_an_error() -> None:
    with pytest.raises(LookupError), background_threads():
        raise LookupError
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_another_policy_is_left_alone() -> None:
    seen: list[int] = []

    def in_idle_policy() -> None:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        with background_threads():
            seen.append(policy_of_a_new_thread())
        seen.append(os.sched_getscheduler(0))

    thread = threading.Thread(target=in_idle_policy)
    thread.start()
    thread.join()
    assert seen == [os.SCHED_IDLE, os.SCHED_IDLE]


def test_calls_run_one_after_the_other_and_give_what_they_return_or_raise() -> None:
    thread = DaemonThread("calls")
    names: list[str] = []

    def call(number: int) -> int:
        names.append(threading.current_thread().name)
        return 12 // number

    results = [thread.submit(call, number) for number in (3, 0, 4)]
    assert [results[0].result(TIMEOUT_S), results[2].result(TIMEOUT_S)] == [4, 3]
    assert isinstance(results[1].exception(), ZeroDivisionError)
    assert names == ["calls"] * 3
    thread.shutdown()


def test_a_running_call_does_not_count_as_waiting() -> None:
    thread, begun, may_end = DaemonThread("calls"), threading.Event(), threading.Event()

    def call() -> None:
        begun.set()
        assert may_end.wait(TIMEOUT_S)

    assert not thread.has_waiting()
    thread.submit(call)
    assert begun.wait(TIMEOUT_S)
    assert not thread.has_waiting()
    waiting = thread.submit(int)
    assert thread.has_waiting()
    may_end.set()
    assert waiting.result(TIMEOUT_S) == 0
    assert not thread.has_waiting()
    thread.shutdown()


def test_what_has_not_begun_is_given_up_and_the_thread_ends_after_what_has() -> None:
    thread = DaemonThread("calls")
    begun, go_on = threading.Event(), threading.Event()

    def wait() -> threading.Thread:
        begun.set()
        assert go_on.wait(TIMEOUT_S)
        return threading.current_thread()

    running, waiting = thread.submit(wait), thread.submit(wait)
    assert begun.wait(TIMEOUT_S)
    thread.shutdown()
    assert waiting.cancelled()
    with pytest.raises(RuntimeError, match="'calls' was shut down"):
        thread.submit(wait)
    go_on.set()
    ended = running.result(TIMEOUT_S)
    ended.join(TIMEOUT_S)
    assert not ended.is_alive()
    thread.shutdown()


def test_a_thread_without_calls_never_begins() -> None:
    before = threading.active_count()
    DaemonThread("calls").shutdown()
    assert threading.active_count() == before


def test_a_process_ends_though_a_call_does_not() -> None:
    program = (
        "import threading; from router.threads import DaemonThread; begun = threading.Event();"
        "thread = DaemonThread('calls'); thread.submit(begun.set); thread.submit(threading.Event().wait);"
        "begun.wait(); thread.shutdown()"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=TIMEOUT_S)


class StillbornThread(Thread):
    """A thread whose Python code does not run until `late` is called, as when there is no memory for it."""

    late: Callable[[], None]

    def _bootstrap(self) -> None:
        self.late = super()._bootstrap  # type: ignore[misc]  # Python's own


def test_a_thread_that_dies_before_it_runs_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "START_S", 0.05)
    called = threading.Event()
    thread = StillbornThread(called.set, "stillborn")
    with pytest.raises(RuntimeError, match="can't start new thread"):
        thread.start()
    has_run = threading.Event()

    def run_late() -> None:
        thread.late()
        has_run.set()

    start_new_thread(run_late, ())
    assert has_run.wait(TIMEOUT_S)
    assert not called.is_set()


def test_an_executor_whose_thread_cannot_be_started_tries_again(monkeypatch: pytest.MonkeyPatch) -> None:
    executor = DaemonThread("calls")
    with monkeypatch.context() as short:
        short.setattr(threads, "START_S", 0.05)
        short.setattr(threads, "Thread", StillbornThread)
        with pytest.raises(RuntimeError, match="can't start new thread"):
            executor.submit(int)
    assert executor.submit(int, "4").result(TIMEOUT_S) == 4
    executor.shutdown()


def test_a_loop_goes_on_when_a_shortage_has_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "REST_S", 0.0)
    shortages = [MemoryError(), OSError(errno.EMFILE, ""), RuntimeError("can't start new thread")]
    ended = threading.Event()

    def loop() -> None:
        if shortages:
            raise shortages.pop()
        ended.set()

    Thread(loop, "loop").start()
    assert ended.wait(TIMEOUT_S)


def test_a_step_of_a_stop_that_is_stuck_is_left_and_the_others_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "STEP_S", 0.05)
    steps, never = list[str](), threading.Event()

    def stuck() -> None:
        never.wait()

    with capture_logs() as logs, StopStack() as stack:
        stack.callback(steps.append, "last")
        stack.callback(stuck)
        inner = stack.enter_context(StopStack(stack))
        inner.callback(steps.append, "second")
        inner.callback(stuck)
        stack.callback(steps.append, "first")
    never.set()
    assert steps == ["first", "second", "last"]
    left = "shutdown step did not finish in time; continuing"
    assert [each["step"].rpartition(".")[2] for each in logs if each["event"] == left] == ["stuck", "stuck"]


def test_an_error_of_a_step_is_raised_after_all_others() -> None:
    steps: list[str] = []

    def fail() -> None:
        raise LookupError

    stack = StopStack()
    stack.callback(steps.append, "last")
    stack.callback(fail)
    with pytest.raises(LookupError):
        stack.close()
    assert steps == ["last"]


def test_a_stop_without_threads_does_each_step_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "START_S", 0.05)
    monkeypatch.setattr(threads, "Thread", StillbornThread)
    steps: list[str] = []
    with StopStack() as stack:
        for number in "321":
            stack.callback(steps.append, number)
    assert steps == ["1", "2", "3"]

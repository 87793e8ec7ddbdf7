"""Background scheduling and the executor that never delays the end of the process."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from router.threads import DaemonThread, background_threads

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
    with pytest.raises(RuntimeError, match="'calls' takes no more"):
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

"""A thread that nobody has to wait for."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from router.threads.daemon_thread import DaemonThread

PATIENCE_SECONDS = 20.0


def test_calls_run_one_after_the_other_and_give_what_they_return_or_raise() -> None:
    thread = DaemonThread("calls")
    names: list[str] = []

    def call(number: int) -> int:
        names.append(threading.current_thread().name)
        return 12 // number

    results = [thread.submit(call, number) for number in (3, 0, 4)]
    assert [results[0].result(PATIENCE_SECONDS), results[2].result(PATIENCE_SECONDS)] == [4, 3]
    assert isinstance(results[1].exception(), ZeroDivisionError)
    assert names == ["calls"] * 3
    thread.shutdown()


def test_what_has_not_begun_is_given_up_and_the_thread_ends_after_what_has() -> None:
    thread = DaemonThread("calls")
    begun, go_on = threading.Event(), threading.Event()

    def wait() -> threading.Thread:
        begun.set()
        assert go_on.wait(PATIENCE_SECONDS)
        return threading.current_thread()

    running, waiting = thread.submit(wait), thread.submit(wait)
    assert begun.wait(PATIENCE_SECONDS)
    thread.shutdown()
    assert waiting.cancelled()
    with pytest.raises(RuntimeError, match="'calls' takes no more"):
        thread.submit(wait)
    go_on.set()
    ended = running.result(PATIENCE_SECONDS)
    ended.join(PATIENCE_SECONDS)
    assert not ended.is_alive()
    thread.shutdown()


def test_a_thread_without_calls_never_begins() -> None:
    before = threading.active_count()
    DaemonThread("calls").shutdown()
    assert threading.active_count() == before


def test_a_process_ends_though_a_call_does_not() -> None:
    program = (
        "import threading; from router.threads.daemon_thread import DaemonThread; begun = threading.Event();"
        "thread = DaemonThread('calls'); thread.submit(begun.set); thread.submit(threading.Event().wait);"
        "begun.wait(); thread.shutdown()"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=PATIENCE_SECONDS)

"""A thread for long work: in order, faults with the one who asked, and nobody waits for its end."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from router.gateway.worker import Worker

PATIENCE_S = 20.0


def test_what_comes_first_is_done_first_and_a_fault_is_told_to_the_one_who_asked() -> None:
    worker, done = Worker("work"), list[int]()
    bad = worker.submit(int, "x")
    futures = [worker.submit(done.append, number) for number in range(100)]
    futures[-1].result(PATIENCE_S)
    assert done == [*range(100)]
    with pytest.raises(ValueError, match="invalid literal"):
        bad.result(0)
    worker.stop()
    assert "work" not in {thread.name for thread in threading.enumerate()}


def test_what_is_cancelled_before_its_turn_is_not_done() -> None:
    worker, go_on, done = Worker("work"), threading.Event(), list[str]()
    worker.submit(go_on.wait, PATIENCE_S)
    unwanted = worker.submit(done.append, "unwanted")
    last = worker.submit(done.append, "last")
    assert unwanted.cancel()
    go_on.set()
    last.result(PATIENCE_S)
    assert done == ["last"]
    worker.stop()


def test_neither_stopping_nor_the_end_of_the_process_waits_for_long_work() -> None:
    story = (
        "import threading; from router.gateway.worker import Worker\n"
        "began, worker = threading.Event(), Worker('work')\n"
        "worker.submit(lambda: began.set() or threading.Event().wait())\n"
        "began.wait(); worker.stop(); print('stopped')"
    )
    ended = subprocess.run(
        [sys.executable, "-c", story], check=False, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "stopped\n", "")

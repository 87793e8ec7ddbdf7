"""A worker whose functions are stuck."""

from __future__ import annotations

import threading
from queue import SimpleQueue
from typing import Any, cast

from router.carrier.ring import Ring
from router.carrier.structures import MessageRecord
from router.carrier.worker import Stage, Worker

WAITING, PUBLISHED = 0, 1


class Records:
    """A ring of which each `take` waits for records."""

    def __init__(self) -> None:
        self.queue: SimpleQueue[bytes] = SimpleQueue()

    def take(self, timeout_ms: int) -> memoryview:
        return memoryview(self.queue.get() if timeout_ms else b"")

    def wake(self) -> None:
        self.queue.put(b"")


def test_counts_balance_while_a_message_is_stuck_after_its_first_target() -> None:
    records, stuck, goes_on = Records(), threading.Event(), threading.Event()
    failures: list[Exception] = []
    worker = Worker("topics", cast("Ring", records), failures.append)
    worker.counts += [0, 0]

    def publish(*_: Any) -> None:
        worker.counts[PUBLISHED] += 1
        stuck.set()
        goes_on.wait(60)

    worker.prepare(Stage(1, {0: (publish, [WAITING])}, ["board"], lambda: None))
    worker.start(1)
    assert worker.wait_for(1, 60)
    assert worker.copy_counts(2) == [0, 0]
    record = MessageRecord(generation=1)
    record.size = len(bytes(record))
    records.queue.put(bytes(record))
    assert stuck.wait(60)
    assert worker.copy_counts(2) == [0, 0]
    worker.forget_copy()
    assert worker.copy_counts(2) == [0, 1]
    goes_on.set()
    assert worker.stop(60)
    assert worker.copy_counts(2) == [-1, 1]
    assert failures == []

"""Keeps threads that only support the receive thread from getting in its way. Knows no thread by name."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def background_threads() -> Iterator[None]:
    """Threads that are started inside, by whatever library, never preempt another thread when they wake.

    They inherit Linux's batch scheduling: the same share of the processor, without the right to interrupt.
    Fast DDS wakes a thread of its own several times per reliable message; on a processor that it shares
    with the receive thread, half of the context switches and about a tenth of the time were spent on that.
    Another policy than the default is somebody's decision, and stays.
    """
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        yield
        return
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))

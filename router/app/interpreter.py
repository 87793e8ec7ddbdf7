"""Settings of the whole Python process, so that nothing keeps a datagram waiting for long."""

from __future__ import annotations

import gc
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_BESIDE = 0.00005
"""Seconds after which a thread that compiles lets the receive thread in, which needs that after each system call."""


def tune_interpreter() -> None:
    """For whoever owns the process: call once, after start, before traffic."""
    gc.freeze()  # what start-up made lives as long as the process: the collector need not look at it again
    may_open, may_ask_for = resource.getrlimit(resource.RLIMIT_NOFILE)
    if may_open not in (resource.RLIM_INFINITY, may_ask_for):  # 1024 are too few for as many clients of a gateway
        resource.setrlimit(resource.RLIMIT_NOFILE, (may_ask_for, may_ask_for))
    sys.setswitchinterval(0.0005)  # the receive thread waits no longer than this for a busy thread to let it in


@contextmanager
def beside_traffic() -> Iterator[None]:
    """Inside, this thread may compute for long: others have their turn more often than otherwise."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(min(usual, _BESIDE))
    try:
        yield
    finally:
        sys.setswitchinterval(usual)

"""Has a thread stand still between two of the things that it does, while another one changes what it works with."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 1.0
"""How long a thread may take to come by; it is stuck if it takes longer. Nothing that comes by UDP is routed meanwhile,
and a service manager's watchdog is not fed."""


class StuckError(RuntimeError):
    """A thread did not come by, and nothing was changed."""


@contextmanager
def parked(ask: Callable[[Callable[[], None]], None]) -> Iterator[None]:
    """`ask(task)` has the thread call `task` when it can, and does not wait for that. Raises StuckError."""
    here, go_on = threading.Event(), threading.Event()

    def stay() -> None:
        here.set()
        go_on.wait()

    try:
        ask(stay)
        if not here.wait(PATIENCE_S):
            raise StuckError("a thread of the router is stuck, or has too much to do: try again")
        yield
    finally:
        go_on.set()

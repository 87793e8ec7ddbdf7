"""What acts by itself when its time has come: a deadman, a pacer, a frame that is never completed.

A machine knows no clock, thread or lock. Who serves it (edges.timekeeper) calls it at the right time, and never
two calls at once.
"""

from __future__ import annotations

from typing import Protocol


class Machine(Protocol):
    """`next_due` is the monotonic time in ns at which `due` is to be called; None when there is nothing to wait for.

    Any call of the machine may change it, to an earlier time as well.
    """

    next_due: int | None

    def due(self, now: int) -> None:
        """Does what is due at `now`, if anything is, and sets `next_due` to a later time."""

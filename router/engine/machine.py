"""What acts by itself when its time has come: a deadman, a pacer, a frame that is never completed.

A machine knows no clock, thread or lock. Who serves it (edges.timekeeper) calls it at the right time, and never
two calls at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Machine(Protocol):
    """`next_due` is the monotonic time in ns at which `due` is to be called; None when there is nothing to wait for.

    Any call of the machine may change it, to an earlier time as well.
    """

    next_due: int | None

    def due(self, now: int) -> None:
        """Does what is due at `now`, if anything is, and sets `next_due` to a time after `now`."""

    def end(self, now: int) -> None:
        """The last call: settles what the machine still holds, so that nothing is lost without being counted."""


class Guard(Protocol):
    """Has `machine` served from now on, and returns `call`, which uses it, as others may call it meanwhile."""

    def __call__(self, machine: Machine, call: Callable[P, R], /) -> Callable[P, R]: ...

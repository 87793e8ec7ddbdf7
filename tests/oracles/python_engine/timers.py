"""Objects with a deadline: deadmen, pacers, held messages, incomplete frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Timer(Protocol):
    """An object that acts at a deadline. The caller provides the clock and never makes two calls at once.

    `next_due` is the time (boot clock, ns) at which `due` is to be called, or None. Any call of the object may change
    it, to an earlier time as well.
    """

    next_due: int | None

    def due(self, now: int) -> None:
        """Act if the deadline has passed, and set `next_due` to a time after `now`."""

    def end(self, now: int) -> None:
        """Settle what is still held, so that every message is counted. The last call."""


class Locked(Protocol):
    """Serve `timer` from now on, and return `call`, a method of it, wrapped in the lock of all timers of its group."""

    def __call__(self, timer: Timer, call: Callable[P, R], /) -> Callable[P, R]: ...

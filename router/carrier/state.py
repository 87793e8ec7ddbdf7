"""What a program keeps from one message to the next, and passes on to the next program."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar, cast

T = TypeVar("T")


class State:
    """What a program keeps, by key; survives a reload.

    A program's state takes over from that of the `previous` program what has the same key: then both programs use the
    same object, whichever of them runs. A key therefore has to contain everything that its object depends on.
    """

    def __init__(self, previous: State | None = None) -> None:
        self._previous: dict[Hashable, object] = previous._kept if previous else {}
        self._kept: dict[Hashable, object] = {}

    def keep(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the object with this key, of this program or the previous one; make it if there is none."""
        if key not in self._kept:
            self._kept[key] = self._previous[key] if key in self._previous else make()
        return cast("T", self._kept[key])

    def forget_previous(self) -> None:
        self._previous = {}

"""What handlers remember from one message to the next, by what it belongs to. Outlives them when a table is reloaded.

Knows no table: what belongs together has equal keys, in which everything stands on which it depends.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from typing import TypeVar, cast

T = TypeVar("T")


class State:
    """Of one program. Made after another one's, it takes over from it what has the same key.

    Both programs then use one object, so it does not matter when which of them stops doing so.
    """

    def __init__(self, before: State | None = None) -> None:
        self._before: dict[Hashable, object] = before._kept if before else {}
        self._kept: dict[Hashable, object] = {}

    def keep(self, key: Hashable, make: Callable[[], T]) -> T:
        """What is kept under `key`, here or before; made if there is none. Keys are the caller's to keep apart."""
        if key not in self._kept:
            self._kept[key] = self._before[key] if key in self._before else make()
        return cast("T", self._kept[key])

    def made(self) -> Iterator[object]:
        """What only this program has."""
        return (value for key, value in self._kept.items() if key not in self._before)

    def left(self) -> Iterator[object]:
        """What only the program before has. Nobody asks for it any more once `settle` was called."""
        return (value for key, value in self._before.items() if key not in self._kept)

    def settle(self) -> None:
        """Forgets what came before."""
        self._before = {}

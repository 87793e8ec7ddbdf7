"""The memory of a program: what C reads of it, block by block."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class Arrays:
    """Structures and arrays of C, which live as long as this object.

    All of a program's memory is in `blocks`, so that an image of it can be made (`image.py`). What it refers to beside
    them, such as senders, is only kept alive.
    """

    blocks: list[Any] = field(default_factory=list)
    references: list[int] = field(default_factory=list)
    """Addresses of words that hold a pointer, where the type of C does not say so."""
    _kept: list[object] = field(default_factory=list)

    def add(self, made: T) -> T:
        """Own a structure or an array."""
        self.blocks.append(made)
        return made

    def array(self, kind: Any, elements: Sequence[Any]) -> Any:
        """Make an array; None, which is NULL, of no elements."""
        return self.add((kind * len(elements))(*elements)) if elements else None

    def text(self, data: bytes) -> int:
        """Return the address of a copy of bytes, never 0."""
        return ctypes.addressof(self.add(ctypes.create_string_buffer(data, len(data) + 1)))

    def keep(self, *others: object) -> None:
        """Keep alive what is no memory of the program."""
        self._kept += others

    def include(self, others: Arrays) -> None:
        """Own all that others own."""
        self.blocks += others.blocks
        self.references += others.references
        self._kept += others._kept

    def clear(self) -> None:
        self.blocks.clear()
        self.references.clear()
        self._kept.clear()

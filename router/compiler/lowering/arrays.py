"""The memory of a program that C reads, in blocks."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class Arrays:
    """C structures and arrays, which live as long as this object: all of an image's memory."""

    blocks: list[Any] = field(default_factory=list)
    references: list[int] = field(default_factory=list)
    """Addresses of words that hold a pointer although their C type does not show it."""

    def add(self, structure: T) -> T:
        """Take ownership of a structure or an array, and return it."""
        self.blocks.append(structure)
        return structure

    def array(self, kind: Any, elements: Sequence[Any]) -> Any:
        """Make an array; None (NULL) if there are no elements."""
        return self.add((kind * len(elements))(*elements)) if elements else None

    def text(self, data: bytes) -> int:
        """Copy bytes, and return the address of the copy, which is never 0."""
        return ctypes.addressof(self.add(ctypes.create_string_buffer(data, len(data) + 1)))

"""Offsets in CDR, as far as they are known: modulo the largest alignment behind the last string or sequence."""

from __future__ import annotations

from dataclasses import dataclass

HIGHEST = 8


@dataclass(slots=True)
class Offset:
    """`residue` modulo `modulus`, a power of two. With 1 nothing is known."""

    modulus: int = 1
    residue: int = 0

    def padding(self, alignment: int) -> int | None:
        """The bytes up to a multiple of `alignment`, None if they are not known."""
        return -self.residue % alignment if alignment <= self.modulus else None

    def advance(self, alignment: int, size: int) -> None:
        """Go behind `size` bytes that are aligned."""
        if alignment > self.modulus:
            self.modulus, self.residue = alignment, 0
        self.residue = (self.residue + -self.residue % alignment + size) % self.modulus

    def lose(self, modulus: int = 1) -> None:
        """Go behind bytes of unknown number, a multiple of `modulus`."""
        self.modulus, self.residue = modulus, 0

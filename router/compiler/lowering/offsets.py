"""Known offsets in CDR, modulo the largest alignment since the last string or sequence."""

from __future__ import annotations

from dataclasses import dataclass

HIGHEST = 8


@dataclass(slots=True)
class Offset:
    """An offset known as `residue` modulo `modulus`, a power of two. With modulus 1, nothing is known."""

    modulus: int = 1
    residue: int = 0

    def padding(self, alignment: int) -> int | None:
        """Return the bytes up to a multiple of `alignment`, None if not known."""
        return -self.residue % alignment if alignment <= self.modulus else None

    def advance(self, alignment: int, size: int) -> None:
        """Skip `size` aligned bytes."""
        if alignment > self.modulus:
            self.modulus, self.residue = alignment, 0
        self.residue = (self.residue + -self.residue % alignment + size) % self.modulus

    def lose(self, modulus: int = 1) -> None:
        """Skip an unknown number of bytes, a multiple of `modulus`."""
        self.modulus, self.residue = modulus, 0

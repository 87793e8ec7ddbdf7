"""Lines of generated code that read CDR bytes in order: as few `struct` calls as alignment allows. Knows no JSON.

What comes before the first string or sequence is one call with all offsets known. Behind it, the position `at` is known
when the code runs, and by its last three bits one of eight unpackers is taken.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from router.compiler.cdr.primitives import HEADER

_INDENT = "    "
_ORIGIN = len(HEADER)
"""Where in the bytes alignment counts from."""
_Take = tuple[str, int, str]
"""Struct format, alignment, and the variable that gets it."""


def _layout(takes: Sequence[_Take], start: int) -> tuple[str, int]:
    """Struct format and size of what begins at `start`."""
    letters, at = ["<"], start
    for letter, alignment, _ in takes:
        padding = (_ORIGIN - at) % alignment
        letters += [f"{padding}x"] * bool(padding) + [letter]
        at += padding + struct.calcsize(f"<{letter}")
    return "".join(letters), at - start


class CdrLines:
    """The lines of one function in the making, and what they find in their namespace."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.constants: dict[str, object] = {}
        self._depth = 0
        self._variables = 0
        self._takes: list[_Take] = []
        self._at: int | None = _ORIGIN
        self._is_behind = False
        self._is_checked = True

    def line(self, text: str) -> None:
        self.lines.append(_INDENT * self._depth + text)

    @contextmanager
    def block(self, text: str) -> Iterator[None]:
        self.line(text)
        self._depth += 1
        yield
        self._depth -= 1

    def variable(self, letter: str) -> str:
        self._variables += 1
        return f"{letter}{self._variables}"

    def take(self, letter: str, alignment: int) -> str:
        """A variable that will hold what `struct` makes of the next bytes, once something of unknown size is read."""
        variable = self.variable("v")
        self._takes.append((letter, alignment, variable))
        return variable

    def read(self) -> None:
        """Reads what was taken so far."""
        takes, self._takes = self._takes, []
        if not takes:
            return
        variables = ", ".join(variable for _, _, variable in takes)
        variables += "," * (len(takes) == 1)
        if self._at is not None:
            letters, size = _layout(takes, self._at)
            self.line(f"{variables} = {self._constant('unpack', struct.Struct(letters).unpack_from)}(cdr, {self._at})")
            self._at += size
        else:
            self._advance()
            layouts = [_layout(takes, phase) for phase in range(8)]
            choices = tuple((struct.Struct(letters).unpack_from, size) for letters, size in layouts)
            self.line(f"unpack, size = {self._constant('unpack_at', choices)}[at & 7]")
            self.line(f"{variables} = unpack(cdr, at)")
            self._is_behind = True
        self._is_checked = True

    def stretch(self, count: str | int, size: int) -> str:
        """Goes past `count` elements of `size` bytes, aligned if there are any. Returns where they begin.

        Whether the message reaches as far is not checked. `size` is at most 4 or `count` comes right after a length.
        """
        start = self._start(count, size)
        length = str(count * size) if isinstance(count, int) else count if size == 1 else f"{count} * {size}"
        self.line(f"at = {start} + {length}")
        self._at, self._is_checked = None, False
        return start

    def _start(self, count: str | int, size: int) -> str:
        if self._at is not None:
            start = self._at + (_ORIGIN - self._at) % size
            if isinstance(count, int) or start == self._at:
                return str(start)
            self.line(f"start = {start} if {count} else {self._at}")
            return "start"
        self._advance()
        self.line("start = at")
        if size > 1:
            padding = f"start += {_ORIGIN} - at & {size - 1}"
            self.line(padding if isinstance(count, int) else f"if {count}: {padding}")
        return "start"

    @contextmanager
    def loop(self, count: str | int) -> Iterator[None]:
        """What is read inside is read `count` times."""
        self._advance()
        if self._at is not None:
            self.line(f"at = {self._at}")
            self._at = None
        with self.block(f"for _ in range({count}):"):
            yield
            self.read()
            self._advance()
        self._is_checked = False

    def finish(self) -> None:
        """Reads the rest, and makes sure that the message does not end before its last field does."""
        self.read()
        if not self._is_checked:
            with self.block("if at > len(cdr):"):
                self.line("cut_off(cdr)")

    def _advance(self) -> None:
        """Brings `at` behind what was unpacked last; not needed where nothing follows."""
        if self._is_behind:
            self.line("at += size")
            self._is_behind = False

    def _constant(self, name: str, value: object) -> str:
        unique = f"{name}_{len(self.constants) + 1}"
        self.constants[unique] = value
        return unique

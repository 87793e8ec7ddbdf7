"""The code that reads wanted fields out of CDR bytes: as few `struct` calls as alignment allows.

What comes before the first string or sequence is one call with all offsets known. Behind it, the position `at` is
known when the code runs, and by its last three bits one of eight unpackers is taken.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from router.compiler.cdr.readers import object_class
from router.compiler.cdr.reading_steps import Leap, Loop, Made, Moment, Object, Step, Stretch, Take, Unpack
from router.compiler.cdr.steps import HEADER
from router.compiler.source import Source
from router.errors import SourceSpan

_PHASES = range(8)
_ORIGIN = len(HEADER)
"""Where in the bytes alignment counts from."""
_WIDEST = 80
"""How many characters of names are put on one line."""


def _layout(takes: Iterable[Take], start: int) -> tuple[str, int]:
    """Struct format and size of what begins at `start`, where this many more bytes than it takes mean nothing."""
    letters, skipped, at = ["<"], 0, start
    for take in takes:
        padding = (_ORIGIN - at) % take.alignment
        at += padding + take.size
        skipped += padding
        if take.variable is None:
            skipped += take.size
            continue
        letters += [f"{skipped}x"] * bool(skipped) + [take.format]
        skipped = 0
    letters += [f"{skipped}x"] * bool(skipped)
    return "".join(letters), at - start


def _leaps(element: Sequence[Take]) -> tuple[list[int], int]:
    """The size of a first message of known size by the phase it begins at, and that of each one which follows.

    Behind a scalar the phase is known modulo its size, so from the second message on all are of one size.
    """
    sizes = [_layout(element, phase)[1] for phase in _PHASES]
    second = sizes[0] % 8
    return sizes, sizes[second]


class ReadingCode:
    """Appends to a function the lines that read `cdr`. `at` is known now as long as that is possible."""

    def __init__(self, out: Source, span: SourceSpan, at: int | None = _ORIGIN) -> None:
        self.out = out
        self.span = span
        self.at = at
        self.is_checked = True
        """Whether `struct` has seen that the bytes reach as far as has been read."""
        self._is_behind = False
        self._together: list[Take] = []
        self._made: list[Made] = []

    def write(self, steps: Iterable[Step]) -> None:
        for step in steps:
            match step:
                case Take():
                    self._together.append(step)
                case Object() | Moment() | Unpack():
                    self._made.append(step)
                case Stretch() | Loop() | Leap():
                    self._flush()
                    self._advance()
                    self._vary(step)
        self._flush()

    def _vary(self, step: Stretch | Loop | Leap) -> None:
        """What has its length in the message."""
        match step:
            case Stretch():
                self._stretch(step)
            case Loop():
                self._loop(step)
            case Leap():
                self._leap(step)

    def _advance(self) -> None:
        """Brings `at` behind what was unpacked last; not needed where nothing follows."""
        if self._is_behind:
            self._line("at += size")
            self._is_behind = False

    def _line(self, text: str) -> None:
        self.out.line(text, self.span)

    def _spread(self, before: str, names: Sequence[str], after: str) -> None:
        """A statement with a tuple in it, one name a line where they are too many for one."""
        together = f"({names[0]},)" if len(names) == 1 else f"({', '.join(names)})"
        if len(together) <= _WIDEST:
            self._line(f"{before}{together}{after}")
            return
        self._line(f"{before}(")
        with self.out.indented():
            for name in names:
                self._line(f"{name},")
        self._line(f"){after}")

    def _flush(self) -> None:
        """Reads what has come together, and makes what waits for it."""
        takes, made = self._together, self._made
        self._together, self._made = [], []
        if takes:
            variables = [take.variable for take in takes if take.variable is not None]
            if self.at is None:
                self._floating(takes, variables)
            else:
                self._static(takes, variables, self.at)
            self.is_checked = bool(variables)
        for one in made:
            self._make(one)

    def _static(self, takes: Sequence[Take], variables: Sequence[str], at: int) -> None:
        letters, size = _layout(takes, at)
        self.at = at + size
        if variables:
            unpack = self.out.constant("unpack_message", struct.Struct(letters).unpack_from)
            self._spread("", variables, f" = {unpack}(cdr, {at})")

    def _floating(self, takes: Sequence[Take], variables: Sequence[str]) -> None:
        layouts = [_layout(takes, phase) for phase in _PHASES]
        if not variables:
            sizes = self.out.constant("sizes_at", tuple(size for _, size in layouts))
            self._line(f"at += {sizes}[at & 7]")
            return
        at = self.out.constant("unpack_at", tuple((struct.Struct(it).unpack_from, size) for it, size in layouts))
        self._line(f"unpack, size = {at}[at & 7]")
        self._spread("", variables, " = unpack(cdr, at)")
        self._is_behind = True

    def _make(self, made: Made) -> None:
        match made:
            case Unpack():
                self._line(f"{made.variable} = numbers({made.letter!r}, {made.size}, {made.variable})")
            case Moment():
                self._line(f"{made.variable} = {made.seconds} * 1_000_000_000 + {made.nanoseconds}")
            case Object():
                make = self.out.constant(f"make_{made.type.short_name}", object_class(made.type))
                self._spread(f"{made.variable} = {make}(", made.fields, ")")

    def _float(self) -> None:
        """From here on `at` is a variable."""
        if self.at is not None:
            self._line(f"at = {self.at}")
            self.at = None

    def _stretch(self, stretch: Stretch) -> None:
        if stretch.size == 8:
            self._float()
            with self.out.block("if length:", self.span):
                self._line(f"at += {_ORIGIN} - at & 7")
        size = "length" if stretch.size == 1 else f"{stretch.size} * length"
        end = f"at + {size}" if self.at is None else "at"
        start = "at" if self.at is None else str(self.at)
        data = f"cdr[{start} : {end}]"
        if stretch.letter is not None:
            data = f"numbers({stretch.letter!r}, {stretch.size}, {data})"
        lines = [f"at += {size}" if self.at is None else f"at = {start} + {size}"]
        if stretch.variable is not None:
            lines.insert(0 if self.at is None else 1, f"{stretch.variable} = {data}")
        for line in lines:
            self._line(line)
        self.at, self.is_checked = None, False

    def _loop(self, loop: Loop) -> None:
        self._float()
        if loop.variable is not None:
            self._line(f"{loop.variable} = []")
        body = ReadingCode(self.out, self.span, None)
        with self.out.block(f"for _ in range({'length' if loop.count is None else loop.count}):", self.span):
            body.write(loop.body)
            body._advance()
            if loop.variable is not None:
                self._line(f"{loop.variable}.append({loop.element})")
        self.is_checked = body.is_checked

    def _leap(self, leap: Leap) -> None:
        self._float()
        sizes, following = _leaps(leap.element)
        with self.out.block("if length:", self.span):
            first = str(sizes[0]) if len({*sizes}) == 1 else f"{self.out.constant('sizes_at', tuple(sizes))}[at & 7]"
            self._line(f"at += {first} + (length - 1) * {following}")
        self.is_checked = False

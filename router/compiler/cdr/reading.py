"""Generate the code that reads wanted fields, and only those, out of the CDR bytes `cdr` of a ROS message.

`steps` makes a message type the flat sequence of what is read or skipped, up to the last wanted field.
`ReadingCode` writes it with as few `struct` calls as alignment allows: one for what comes before the first string or
sequence, where all offsets are known; behind it the position `at` is known when the code runs, and its last three
bits select one of eight unpackers.
"""

from __future__ import annotations

import ast
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Union

from router.compiler.cdr.primitives import HEADER, decoder, object_class, scalar_format
from router.compiler.expressions.kinds import TIME_TYPES
from router.compiler.expressions.tree import Path
from router.compiler.source import Source, call, load
from router.errors import SourceSpan
from router.types.model import Int, List, MessageType, String, Type


@dataclass(frozen=True, slots=True)
class Take:
    """Bytes of known size: `format` is for struct, `variable` gets the value, None skips it."""

    format: str
    alignment: int
    variable: str | None

    @property
    def size(self) -> int:
        return struct.calcsize(f"<{self.format}")


LENGTH = Take("I", 4, "length")
"""The length before a Stretch, a Leap, and a Loop without a known count."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A string or a sequence of scalars: `length` units of `size` bytes. With `letter`, they become numbers."""

    size: int
    variable: str | None
    letter: str | None = None


@dataclass(frozen=True, slots=True)
class Loop:
    """`body`, repeated `count` times, or `length` times if that is None; the list `variable` gets each `element`."""

    count: int | None
    body: tuple[Step, ...]
    element: str
    variable: str | None


@dataclass(frozen=True, slots=True)
class Leap:
    """An unwanted sequence of `length` messages of known size, skipped at once."""

    element: tuple[Take, ...]


@dataclass(frozen=True, slots=True)
class Object:
    """An object made for a message, from the variables `fields`. It decodes text where it is used."""

    variable: str
    type: MessageType
    fields: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Moment:
    """A time or a duration in ns, made from its two fields."""

    variable: str
    seconds: str
    nanoseconds: str


@dataclass(frozen=True, slots=True)
class Unpack:
    """An array of scalars, made from the bytes that a Take has left in `variable`."""

    variable: str
    letter: str
    size: int


Made = Union[Object, Moment, Unpack]
"""Values that are made from others that were read before."""

Step = Union[Take, Stretch, Loop, Leap, Made]


def steps(message: MessageType, wanted: Collection[Path], variable: Callable[[Path], str]) -> Sequence[Step]:
    """The steps that read `wanted`: paths of fields, or of messages that become objects. `variable` names paths."""
    found = list(_Walk(wanted, variable).message(message, ()))
    while found and not _is_wanted(found[-1]):
        found.pop()
    return found


def _is_wanted(step: Step) -> bool:
    match step:
        case Take() | Stretch() | Loop():
            return step.variable is not None and step is not LENGTH
        case Leap():
            return False
        case Object() | Moment() | Unpack():
            return True


@dataclass(frozen=True, slots=True)
class _Walk:
    wanted: Collection[Path]
    variable: Callable[[Path], str]

    def steps(self, declared: Type, path: Path, whole: bool) -> Iterator[Step]:
        """The steps of one field. `whole` says that all of a message around it is wanted."""
        whole = whole or path in self.wanted
        variable = self.variable(path) if whole else None
        match declared:
            case MessageType():
                yield from self.message(declared, path, whole)
            case List():
                yield from self._list(declared, path, variable)
            case String():
                yield LENGTH
                yield Stretch(4 if declared.wide else 1, variable)
            case _:
                letter = scalar_format(declared)
                yield Take(letter, struct.calcsize(letter), variable)

    def message(self, declared: MessageType, path: Path, whole: bool = False) -> Iterator[Step]:
        whole = whole or path in self.wanted
        for member in declared.fields:
            yield from self.steps(member.type, (*path, member.name), whole)
        if not declared.fields:
            # Read where objects are made, so that a list cannot claim more of them than there are bytes.
            yield Take("B", 1, self.variable((*path, "nothing")) if whole else None)
        if whole:
            fields = tuple(self.variable((*path, member.name)) for member in declared.fields)
            is_moment = path != () and declared.name in TIME_TYPES  # a topic of times gives messages as others do
            yield Moment(self.variable(path), *fields) if is_moment else Object(self.variable(path), declared, fields)

    def _list(self, declared: List, path: Path, variable: str | None) -> Iterator[Step]:
        if declared.length is None:
            yield LENGTH
        if isinstance(declared.element, (MessageType, String)):
            yield from self._elements(declared, path, variable)
            return
        letter = scalar_format(declared.element)
        size = struct.calcsize(letter)
        are_bytes = declared.element == Int(8, signed=False)  # which bytes are already
        if declared.length is None:
            yield Stretch(size, variable, None if are_bytes else letter)
            return
        yield Take(f"{declared.length * size}s", size, variable)
        if variable is not None and not are_bytes:
            yield Unpack(variable, letter, size)

    def _elements(self, declared: List, path: Path, variable: str | None) -> Iterator[Step]:
        """The steps of a list whose elements are messages or strings."""
        item = (*path, "item")
        body = tuple(self.steps(declared.element, item, variable is not None))
        fixed = tuple(step for step in body if isinstance(step, Take))
        if variable is not None or fixed != body:
            yield Loop(declared.length, body, self.variable(item), variable)
        elif declared.length is None:
            yield Leap(fixed)
        else:
            yield from fixed * declared.length


_PHASES = range(8)
_ORIGIN = len(HEADER)
"""The offset that alignment counts from."""
_WIDEST = 80
"""Characters of names on one line."""


def _layout(takes: Iterable[Take], start: int) -> tuple[str, int]:
    """Struct format and size of takes that begin at offset `start`."""
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
    """The size of a first message by the phase it begins at, and the size of each following one.

    Behind a scalar the phase is known modulo its size, so all messages from the second on have one size.
    """
    sizes = [_layout(element, phase)[1] for phase in _PHASES]
    second = sizes[0] % 8
    return sizes, sizes[second]


class ReadingCode:
    """Appends to a function the lines that read `cdr`. `at` is the offset as long as it is known, then None."""

    def __init__(self, out: Source, span: SourceSpan, at: int | None = _ORIGIN) -> None:
        self.out = out
        self.span = span
        self.at = at
        self.is_checked = True
        """Whether `struct` has checked that the bytes reach as far as has been read."""
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
        """Append a step whose length is in the message."""
        match step:
            case Stretch():
                self._stretch(step)
            case Loop():
                self._loop(step)
            case Leap():
                self._leap(step)

    def _advance(self) -> None:
        """Move `at` behind what was unpacked last; not needed if nothing follows."""
        if self._is_behind:
            self._line("at += size")
            self._is_behind = False

    def _line(self, text: str) -> None:
        self.out.line(text, self.span)

    def _spread(self, before: str, names: Sequence[str], after: str) -> None:
        """Append a statement around a tuple, one name a line if they are too many."""
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
        """Append the code for collected takes, and for the values that are made from them."""
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
        """Make `at` a variable from here on."""
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


class CdrReads:
    """Reads of a serialized ROS message: the fields at `paths`, and nothing behind the last of them.

    `values` are the expressions for those fields, once the statements that `write` appends have run. They raise
    MappingError or struct.error if the bytes are no such message. Strings are decoded where they are used, so that an
    invalid one affects only the targets that use it.
    """

    def __init__(self, message: MessageType, paths: Iterable[Path]) -> None:
        self._message = message
        self._variables: dict[Path, str] = {(): "m"}
        self.values: dict[Path, ast.expr] = {path: self._value(path) for path in paths}

    def _value(self, path: Path) -> ast.expr:
        declared: Type = self._message
        for name in path:
            member = declared.field(name) if isinstance(declared, MessageType) else None
            assert member is not None  # noqa: S101 - a path of a checked expression
            declared = member.type
        variable, decode = load(self._variable(path)), decoder(declared)
        return call(decode.__name__, variable) if decode else variable

    def _variable(self, path: Path) -> str:
        """The variable for a path, the same each time."""
        if path not in self._variables:
            variable = "_".join((self._variables[()], *path))
            while variable in self._variables.values():  # a.b_c and a_b.c
                variable += "_"
            self._variables[path] = variable
        return self._variables[path]

    def write(self, out: Source, span: SourceSpan) -> None:
        """Append the statements that read the fields."""
        with out.block("if cdr[:2] != CDR_LE:", span):
            out.line("refuse(cdr[:2])", span)
        code = ReadingCode(out, span)
        code.write(steps(self._message, self.values, self._variable))
        if not code.is_checked:
            with out.block("if at > len(cdr):", span):
                out.line("cut_off(cdr)", span)

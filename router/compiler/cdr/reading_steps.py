"""A message type as the flat sequence of what is read or passed over, in order, up to the last wanted field.

Knows sizes, alignments and variables; not how code comes of it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Union

from router.compiler.cdr.steps import scalar_format
from router.compiler.expressions.reads import Path
from router.compiler.kinds import OCTET, TIME_TYPES
from router.types.model import List, MessageType, String, Type


@dataclass(frozen=True, slots=True)
class Take:
    """Bytes of known size: `format` is what struct makes of them, `variable` where that goes, None for nowhere."""

    format: str
    alignment: int
    variable: str | None

    @property
    def size(self) -> int:
        return struct.calcsize(f"<{self.format}")


LENGTH = Take("I", 4, "length")
"""What stands before a Stretch, before a Loop of no known count, and before a Leap."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A string or a sequence of scalars: `length` units of `size` bytes. `letter` where they become numbers."""

    size: int
    variable: str | None
    letter: str | None = None


@dataclass(frozen=True, slots=True)
class Loop:
    """`body` again and again, `count` times or else `length`; it leaves in `element` what the list `variable` gets."""

    count: int | None
    body: tuple[Step, ...]
    element: str
    variable: str | None


@dataclass(frozen=True, slots=True)
class Leap:
    """A sequence that nobody wants, of `length` messages of known size: no need to look at each."""

    element: tuple[Take, ...]


@dataclass(frozen=True, slots=True)
class Object:
    """An object of a message's class, of the expressions that are its fields."""

    variable: str
    type: MessageType
    fields: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Moment:
    """A time or a duration, in ns, of its two fields."""

    variable: str
    seconds: str
    nanoseconds: str


@dataclass(frozen=True, slots=True)
class Unpack:
    """An array of scalars, of which a Take has left the bytes in `variable`."""

    variable: str
    letter: str
    size: int


Made = Union[Object, Moment, Unpack]
"""What is made of others that were read before."""

Step = Union[Take, Stretch, Loop, Leap, Made]


def steps(message: MessageType, wanted: Collection[Path], variable: Callable[[Path], str]) -> Sequence[Step]:
    """`wanted` are paths of fields, or of messages that become objects; `variable` names what is at a path."""
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

    def value(self, declared: Type, path: Path) -> str:
        """The expression that is a field's whole value, once its steps are done."""
        variable = self.variable(path)
        decode = decoder(declared)
        return f"{decode}({variable})" if decode else variable

    def steps(self, declared: Type, path: Path, whole: bool) -> Iterator[Step]:
        """`whole` where all of a message around it is wanted."""
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
            fields = tuple(self.value(member.type, (*path, member.name)) for member in declared.fields)
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
        are_bytes = declared.element == OCTET  # which bytes are already
        if declared.length is None:
            yield Stretch(size, variable, None if are_bytes else letter)
            return
        yield Take(f"{declared.length * size}s", size, variable)
        if variable is not None and not are_bytes:
            yield Unpack(variable, letter, size)

    def _elements(self, declared: List, path: Path, variable: str | None) -> Iterator[Step]:
        """Of a list whose elements are messages or strings."""
        item = (*path, "item")
        body = tuple(self.steps(declared.element, item, variable is not None))
        fixed = tuple(step for step in body if isinstance(step, Take))
        if variable is not None or fixed != body:
            yield Loop(declared.length, body, self.variable(item), variable)
        elif declared.length is None:
            yield Leap(fixed)
        else:
            yield from fixed * declared.length


def decoder(declared: Type) -> str | None:
    """The function that makes text of what is read for a field; None where that is the value already."""
    match declared:
        case String():
            return "wide_text" if declared.wide else "text"
        case List(element=String(wide=wide)):
            return "wide_texts" if wide else "texts"
        case _:
            return None

"""The oracle's kinds and values: numbers as in docs/reference/table.md, and fields in expressions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Union

from router.errors import MappingError
from router.types.model import Bool, Bytes, Enum, Float, Int, List, MessageType, String, Type

NS = 1_000_000_000
MAPPING_ERROR, NON_FINITE = "mapping_error", "non_finite"


class Refused(MappingError):
    """There is no result. `reasons` has several entries if the reason depends on the order of evaluation."""

    def __init__(self, *reasons: str) -> None:
        super().__init__(" or ".join(sorted(reasons)))
        self.reasons = frozenset(reasons)


class Nanoseconds(int):
    """A time, as a type distinct from numbers."""


class EnumNumber(int):
    """The value of a protobuf enum, as a type distinct from numbers, because it saturates."""


# kinds


@dataclass(frozen=True, slots=True)
class Truth:
    pass


@dataclass(frozen=True, slots=True)
class Whole:
    low: int
    high: int


@dataclass(frozen=True, slots=True)
class Real:
    """`low` and `high` are the bounds of clamp(), if they are constants."""

    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class Text:
    pass


@dataclass(frozen=True, slots=True)
class Time:
    pass


@dataclass(frozen=True, slots=True)
class Member:
    enum: Enum


@dataclass(frozen=True, slots=True)
class Message:
    type: MessageType


@dataclass(frozen=True, slots=True)
class Listing:
    """`length` is None if the type does not determine it. An empty literal has no `element`."""

    element: Kind | None
    length: int | None = None


Kind = Union[Truth, Whole, Real, Text, Time, Member, Message, Listing]

INT32 = Whole(-(1 << 31), (1 << 31) - 1)
SIGNED = Whole(-(1 << 63), (1 << 63) - 1)
UNSIGNED = Whole(0, (1 << 64) - 1)
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
"""Messages that expressions read as one value."""


def kind_of(declared: Type) -> Kind:
    match declared:
        case Bool():
            return Truth()
        case Int():
            return Whole(declared.low, declared.high)
        case Float():
            return Real()
        case String():
            return Text()
        case Bytes():
            return Listing(Whole(0, 255))
        case Enum():
            return Member(declared)
        case List():
            return Listing(kind_of(declared.element), declared.length)
        case MessageType():
            return Time() if declared.name in TIMES else Message(declared)


def whole(bounds: Iterable[int]) -> Whole:
    """The integers of this range that fit in 64 bits."""
    made = [*bounds]
    limits = SIGNED if min(made) < 0 else UNSIGNED
    return Whole(max(min(made), limits.low), min(max(made), limits.high))


def number(kind: Kind) -> Whole | Real:
    """The kind of a number; an enum is any int32."""
    if isinstance(kind, Member):
        return INT32
    if isinstance(kind, (Whole, Real)):
        return kind
    raise TypeError(f"{kind} is no number")


def joined(kinds: Sequence[Kind]) -> Kind:
    """The common kind of these kinds."""
    first, *others = kinds
    if all(kind == first for kind in others):
        return first
    if all(isinstance(kind, Listing) for kind in kinds):
        lists = [kind for kind in kinds if isinstance(kind, Listing)]
        elements = [kind.element for kind in lists if kind.element is not None]
        lengths = {kind.length for kind in lists}
        return Listing(joined(elements) if elements else None, lengths.pop() if len(lengths) == 1 else None)
    numbers = [number(kind) for kind in kinds]
    wholes = [kind for kind in numbers if isinstance(kind, Whole)]
    if len(wholes) < len(numbers):
        return Real()
    return whole([bound for kind in wholes for bound in (kind.low, kind.high)])


def shaped(value: Any, kind: Kind) -> Any:
    """A value converted to this kind. Raises Refused for an integer that does not fit."""
    match kind:
        case Whole(low, high):
            if not low <= value <= high:
                raise Refused(MAPPING_ERROR)
            return int(value)
        case Real():
            return float(value)
        case Member():
            return EnumNumber(value)
        case Time():
            return Nanoseconds(value)
        case Listing(element) if element is not None:
            return all_of([partial(shaped, each, element) for each in value])
        case _:
            return value


Computation = Callable[[], Any]
"""Returns a value or raises Refused."""


def all_of(computations: Iterable[Computation]) -> list[Any]:
    """The results of computations. If some are refused, raises Refused with the reasons of all of them."""
    made: list[Any] = []
    reasons: set[str] = set()
    for compute in computations:
        try:
            made.append(compute())
        except Refused as refused:
            reasons |= refused.reasons
    if reasons:
        raise Refused(*reasons)
    return made


def known(values: Iterable[Any]) -> list[Computation]:
    """Values as computations."""
    return [partial(_itself, value) for value in values]


def _itself(value: Any) -> Any:
    return value


# messages


@dataclass(frozen=True, slots=True)
class View:
    """A message, as an object or a mapping, with its type model."""

    message: Any
    type: MessageType

    def read(self, name: str) -> Any:
        """The value of a field. Raises KeyError if the type has no field of this name."""
        field = self.type.field(name)
        if field is None:
            raise KeyError(f"{self.type} has no field '{name}'")
        return seen(self.raw(name), field.type)

    def raw(self, name: str) -> Any:
        return self.message[name] if isinstance(self.message, Mapping) else getattr(self.message, name)


def seen(raw: Any, declared: Type) -> Any:
    """A field's value in expressions. Raises Refused for text that is not UTF-8, which is given as bytes."""
    match declared:
        case MessageType() if declared.name in TIMES:
            time = View(raw, declared)
            return Nanoseconds(time.raw("sec") * NS + time.raw("nanosec"))
        case MessageType():
            return View(raw, declared)
        case Enum():
            return EnumNumber(raw)
        case Bytes():
            return list(raw)
        case List():
            return all_of([partial(seen, each, declared.element) for each in raw])
        case String() if isinstance(raw, bytes):
            try:
                return raw.decode()
            except UnicodeDecodeError:
                raise Refused(MAPPING_ERROR) from None
        case _:
            return raw

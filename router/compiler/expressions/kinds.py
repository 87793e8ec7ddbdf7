"""What an expression can be: the static types of the expression language, with integer ranges.

A kind says more than a field's type (the range of an integer, the length of a list) and less (a `uint8` and an `int32`
are both integers).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Union

from router.types.model import Bool, Bytes, Enum, Float, Int, List, MessageType, String, Type

TIME_TYPES = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
"""ROS messages that expressions see as one value: a time or a duration, in nanoseconds."""

INT32 = Int(32, signed=True)
"""The values of an enum."""

OCTET = Int(8, signed=False)
"""An element of bytes."""


@dataclass(frozen=True, slots=True)
class BoolKind:
    def __str__(self) -> str:
        return "bool"


@dataclass(frozen=True, slots=True)
class IntKind:
    """An integer between `low` and `high`; None if the bounds are known at run time only."""

    low: int | None
    high: int | None

    @property
    def bounds(self) -> tuple[int, int] | None:
        """Both bounds, or None if they are known at run time only."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    def __str__(self) -> str:
        if self.bounds is None:
            return "int"
        for bits in (8, 16, 32, 64):
            for signed in (False, True):
                if (Int(bits, signed).low, Int(bits, signed).high) == self.bounds:
                    return str(Int(bits, signed))
        return f"int {self.low}" if self.low == self.high else f"int {self.low}..{self.high}"


@dataclass(frozen=True, slots=True)
class FloatKind:
    """`bits` is 64 if a double went in, so that a float32 would lose digits."""

    bits: int

    def __str__(self) -> str:
        return f"float{self.bits}"


@dataclass(frozen=True, slots=True)
class StringKind:
    def __str__(self) -> str:
        return "string"


@dataclass(frozen=True, slots=True)
class BytesKind:
    def __str__(self) -> str:
        return "bytes"


@dataclass(frozen=True, slots=True)
class EnumKind:
    enum: Enum

    def __str__(self) -> str:
        return f"enum {self.enum.name}"


@dataclass(frozen=True, slots=True)
class TimeKind:
    """Nanoseconds, as a Python integer."""

    def __str__(self) -> str:
        return "time"


@dataclass(frozen=True, slots=True)
class MessageKind:
    type: MessageType

    def __str__(self) -> str:
        return self.type.name


@dataclass(frozen=True, slots=True)
class ListKind:
    """`length` is None if it is known at run time only. An empty literal has no `element`."""

    element: Kind | None
    length: int | None = None

    def __str__(self) -> str:
        return f"list of {self.element}" if self.element else "empty list"


ANY_INT = IntKind(None, None)
UINT32 = IntKind(0, 0xFFFF_FFFF)
"""A number of elements, and the index of one."""

Kind = Union[BoolKind, IntKind, FloatKind, StringKind, BytesKind, EnumKind, TimeKind, MessageKind, ListKind]
Number = (IntKind, FloatKind, EnumKind)
"""The kinds that arithmetic takes, for isinstance()."""


def kind_of(declared: Type) -> Kind:
    """The kind of a field of this type."""
    match declared:
        case Bool():
            return BoolKind()
        case Int():
            return IntKind(declared.low, declared.high)
        case Float():
            return FloatKind(declared.bits)
        case String():
            return StringKind()
        case Bytes():
            return BytesKind()
        case Enum():
            return EnumKind(declared)
        case List():
            return ListKind(kind_of(declared.element), declared.length)
        case MessageType():
            return TimeKind() if declared.name in TIME_TYPES else MessageKind(declared)


def as_int(kind: Kind) -> IntKind | None:
    """The integer that a number of this kind is, an enum being any int32; None for other kinds."""
    if isinstance(kind, EnumKind):
        return IntKind(INT32.low, INT32.high)
    return kind if isinstance(kind, IntKind) else None


def float_bits(kind: Kind) -> int:
    """The width that this number requires of a float result; integers require 32."""
    return kind.bits if isinstance(kind, FloatKind) else 32


def join(left: Kind, right: Kind) -> Kind | None:
    """The kind of a value that is one or the other, None when nothing holds both."""
    if left == right:
        return left
    if isinstance(left, Number) and isinstance(right, Number):
        return _join_numbers(left, right)
    if isinstance(left, ListKind) and isinstance(right, ListKind):
        return _join_lists(left, right)
    return None


def _join_numbers(left: Kind, right: Kind) -> Kind:
    a, b = as_int(left), as_int(right)
    if a is None or b is None:
        return FloatKind(max(float_bits(left), float_bits(right)))
    if a.bounds is None or b.bounds is None:
        return ANY_INT
    return IntKind(min(*a.bounds, *b.bounds), max(*a.bounds, *b.bounds))


def _join_lists(left: ListKind, right: ListKind) -> Kind | None:
    if left.element is None or right.element is None:
        return ListKind(left.element or right.element)
    element = join(left.element, right.element)
    return ListKind(element, left.length if left.length == right.length else None) if element else None

"""The static types of the expression language, with integer ranges.

A kind has more information than a field's type (the range of an integer, the length of a list) and less (a `uint8` and
an `int32` are both integers).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Union

from router.types.model import Bool, Bytes, Enum, Float, Int, List, MessageType, String, Type

TIME_TYPES = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
"""ROS messages that are one value in expressions: a time or a duration, in nanoseconds."""

STAMP_TYPES = frozenset({"builtin_interfaces/msg/Time", "google.protobuf.Timestamp"})
"""Points in time: whole seconds, and nanoseconds that are never negative."""

PROTOBUF_DURATION = "google.protobuf.Duration"
"""A duration whose nanoseconds have the sign of its seconds; in ROS they are never negative."""

DURATION_TYPES = frozenset({"builtin_interfaces/msg/Duration", PROTOBUF_DURATION})


@dataclass(frozen=True, slots=True)
class BoolKind:
    def __str__(self) -> str:
        return "bool"


@dataclass(frozen=True, slots=True)
class IntKind:
    """An integer between `low` and `high`.

    With `is_rounded`, it was computed from a rounded float. It may fill a narrower field, which is checked at run time.
    """

    low: int
    high: int
    is_rounded: bool = False

    def holds(self, other: IntKind) -> bool:
        """Return whether this kind contains all integers of another one."""
        return self.low <= other.low and other.high <= self.high

    def __str__(self) -> str:
        for declared in (Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (False, True)):
            if (declared.low, declared.high) == (self.low, self.high):
                return str(declared)
        return f"int {self.low}" if self.low == self.high else f"int {self.low}..{self.high}"


OCTET, UINT32 = IntKind(0, 0xFF), IntKind(0, 0xFFFF_FFFF)
"""The kinds of an element of bytes, and of a count or an index."""

INT32 = IntKind(-(1 << 31), (1 << 31) - 1)
"""The range of an enum's values."""

INT64, UINT64 = IntKind(-(1 << 63), (1 << 63) - 1), IntKind(0, (1 << 64) - 1)
"""The largest ranges of an integer: INT64 if it may be negative, else UINT64."""


@dataclass(frozen=True, slots=True)
class FloatKind:
    """A float between `low` and `high`, or NaN.

    `bits` is 64 if it was computed from a double: a float32 would lose digits.
    """

    bits: int
    low: float = -math.inf
    high: float = math.inf

    @property
    def limits(self) -> tuple[float, float]:
        return self.low, self.high

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
    """A list; `length` is None if it is only known at run time. An empty literal has no `element`."""

    element: Kind | None
    length: int | None = None

    def __str__(self) -> str:
        return f"list of {self.element}" if self.element else "empty list"


Kind = Union[BoolKind, IntKind, FloatKind, StringKind, BytesKind, EnumKind, TimeKind, MessageKind, ListKind]
Number = (IntKind, FloatKind, EnumKind)
"""The kinds that arithmetic takes, for isinstance()."""


def kind_of(declared: Type) -> Kind:
    """Return the kind of a field of this type."""
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
    """Return the integer kind of a number; an enum can be any int32. Return None for other kinds."""
    if isinstance(kind, EnumKind):
        return INT32
    return kind if isinstance(kind, IntKind) else None


def element_of(kind: Kind) -> Kind | None:
    """Return the kind of a list's elements; bytes are a list of uint8. None for other kinds and an empty literal."""
    if isinstance(kind, BytesKind):
        return OCTET
    return kind.element if isinstance(kind, ListKind) else None


_MOST_FIELDS = 4


def fields_hint(kind: Kind) -> str:
    """Return a hint for a message where a scalar is needed; empty for other kinds."""
    if not isinstance(kind, MessageKind):
        return ""
    names = [member.name for member in kind.type.fields]
    return f"name one of its fields: {', '.join(names[:_MOST_FIELDS])}{', ...' * (len(names) > _MOST_FIELDS)}"


def is_list(kind: Kind) -> bool:
    """Return whether a value of this kind has elements; text has none."""
    return isinstance(kind, (ListKind, BytesKind))


def length_of(kind: Kind) -> int | None:
    """Return the length of a list, None if it is only known at run time."""
    return kind.length if isinstance(kind, ListKind) else None


def within_64_bits(extremes: Iterable[int], is_rounded: bool) -> tuple[IntKind | None, bool]:
    """Return the kind of the integers between `extremes` that fit 64 bits, and whether some do not.

    The kind is None if no integer fits.
    """
    values = [*extremes]
    low, high = min(values), max(values)
    limits = INT64 if low < 0 else UINT64
    cut = IntKind(max(low, limits.low), min(high, limits.high), is_rounded)
    return (cut if cut.low <= cut.high else None), (cut.low, cut.high) != (low, high)


def float_bits(kind: Kind) -> int:
    """Return the width that this number requires of a float result; integers require 32."""
    return kind.bits if isinstance(kind, FloatKind) else 32


def join(left: Kind, right: Kind) -> Kind | None:
    """Return the kind of a value that is one or the other, None if no kind holds both.

    A joined integer kind may be narrower than both together. Values outside its range are rejected at run time.
    """
    if left == right:
        return left
    if isinstance(left, Number) and isinstance(right, Number):
        return _join_numbers(left, right)
    if isinstance(left, ListKind) and isinstance(right, ListKind):
        return _join_lists(left, right)
    return None


def _join_numbers(left: Kind, right: Kind) -> Kind | None:
    a, b = as_int(left), as_int(right)
    if a is None or b is None:
        bits = max(float_bits(left), float_bits(right))
        if isinstance(left, FloatKind) and isinstance(right, FloatKind) and left.limits == right.limits:
            return replace(left, bits=bits)
        return FloatKind(bits)
    return within_64_bits((a.low, a.high, b.low, b.high), a.is_rounded or b.is_rounded)[0]


def _join_lists(left: ListKind, right: ListKind) -> Kind | None:
    if left.element is None or right.element is None:
        return ListKind(left.element or right.element)
    element = join(left.element, right.element)
    return ListKind(element, left.length if left.length == right.length else None) if element else None

"""What an expression computes, as operations: the types of values, and conversions between them.

A checked expression has a kind already, but here the range of each integer has to be known, as the carrier computes
with 64 bits. What Python computes without bounds and the carrier cannot, needs Python.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Union

from router.compiler.lowering.operations import Code, Op, Operation

INT64 = -(1 << 63), (1 << 63) - 1
UINT64 = 0, (1 << 64) - 1
EXACT = 1 << 53
"""Up to this magnitude every integer is exactly a real number."""


class NeedsPython(Exception):
    """Why an expression cannot be lowered."""


@dataclass(frozen=True, slots=True)
class Integer:
    low: int
    high: int

    @property
    def is_signed(self) -> bool:
        return INT64[0] <= self.low and self.high <= INT64[1]

    @property
    def is_unsigned(self) -> bool:
        return self.low >= 0 and self.high <= UINT64[1]

    @property
    def is_exact(self) -> bool:
        """Whether it is exactly a real number, whatever its value."""
        return self.low >= -EXACT and self.high <= EXACT


@dataclass(frozen=True, slots=True)
class Real:
    """A float32 or a double: all are computed as doubles."""


@dataclass(frozen=True, slots=True)
class Rounded:
    """A rounded number: in Python an integer without bounds, here a real one that is whole and finite."""


@dataclass(frozen=True, slots=True)
class Truth:
    """An integer, 0 or 1."""


@dataclass(frozen=True, slots=True)
class Text:
    """UTF-8 of at most so many bytes."""

    most: int


@dataclass(frozen=True, slots=True)
class Octets:
    """Bytes."""


Type = Union[Integer, Real, Rounded, Truth, Text, Octets]


class Value(NamedTuple):
    """What operations leave on the stack."""

    code: Code
    type: Type

    def then(self, kind: Op, type_: Type | None = None, **operands: int) -> Value:
        return Value((*self.code, Operation(kind, **operands)), type_ or self.type)  # type: ignore[arg-type]


def integer(number: int) -> Value:
    bits = number if number <= INT64[1] else number - (1 << 64)
    return Value((Operation(Op.INTEGER, number=bits),), in_range(number, number))


def real(number: float) -> Value:
    return Value((Operation(Op.REAL, number=float(number)),), Real())


def text(literal: str) -> Value:
    data = literal.encode()
    return Value((Operation(Op.TEXT, data=data, size=len(data)),), Text(len(data)))


def in_range(low: int, high: int) -> Integer:
    """The type of an integer. Raises NeedsPython beyond 64 bits."""
    made = Integer(low, high)
    if not (made.is_signed or made.is_unsigned):
        raise NeedsPython("an integer in it may have more than 64 bits")
    return made


def to_real(value: Value, *, exactly: bool = False) -> Value:
    """Convert a number as Python converts integers. `exactly`: it may lose nothing, as in comparisons."""
    match value.type:
        case Integer() as kind:
            if exactly and not kind.is_exact:
                raise NeedsPython("an integer in it may have more digits than a double")
            return value.then(Op.INTEGER_TO_REAL, Real(), flag=not kind.is_signed)
        case Rounded():
            return Value(value.code, Real())
        case _:
            return value


def alike(values: Sequence[Value]) -> list[Value]:
    """Convert values to the type that holds all of them, exactly."""
    types = [value.type for value in values]
    if all(isinstance(each, Integer) for each in types):
        in_range(min(each.low for each in types), max(each.high for each in types))  # type: ignore[union-attr]
        return list(values)
    if all(isinstance(each, (Integer, Rounded)) for each in types):
        return [Value(to_real(value, exactly=True).code, Rounded()) for value in values]
    if all(isinstance(each, (Integer, Rounded, Real)) for each in types):
        return [to_real(value, exactly=True) for value in values]
    return list(values)


def common(values: Sequence[Value]) -> Type:
    """The type of one of several values, which are alike."""
    types = [value.type for value in values]
    if isinstance(types[0], Integer):
        bounds = [each for each in types if isinstance(each, Integer)]
        return in_range(min(each.low for each in bounds), max(each.high for each in bounds))
    if isinstance(types[0], Text):
        return Text(max(each.most for each in types if isinstance(each, Text)))
    return types[0]


def signed(*values: Value) -> bool:
    """Whether all are integers within int64."""
    return all(isinstance(each.type, Integer) and each.type.is_signed for each in values)


def unsigned(*values: Value) -> bool:
    """Whether all are integers within uint64."""
    return all(isinstance(each.type, Integer) and each.type.is_unsigned for each in values)


def want_signed(*values: Value) -> None:
    if not signed(*values):
        raise NeedsPython("an integer in it may have more than 63 bits")


def joined(*codes: Code) -> Code:
    return tuple(operation for code in codes for operation in code)

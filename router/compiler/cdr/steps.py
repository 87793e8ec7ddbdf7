"""A plan as the flat sequence of what is written, in order: scalars, known bytes, strings, lists.

Knows sizes and alignments; not how code comes of it.
"""

from __future__ import annotations

import ast
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Union

from router.compiler.cdr.writers import put_text, put_wide_text
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.errors import SourceSpan
from router.types.model import Bool, Float, Int, List, MessageType, String, Type

HEADER = b"\x00\x01\x00\x00"
"""Representation identifier CDR_LE and two option bytes."""

CDR_LE = HEADER[:2]

_EMPTY = b"\0"
"""What stands for a message without fields: IDL has none, so rosidl adds `structure_needs_at_least_one_member`."""

_INTEGERS = {8: "B", 16: "H", 32: "I", 64: "Q"}


@dataclass(frozen=True, slots=True)
class Put:
    """A scalar: `format` is its struct letter, so its size and alignment; `node` computes it."""

    format: str
    node: ast.expr
    span: SourceSpan

    @property
    def size(self) -> int:
        return struct.calcsize(self.format)

    alignment = size


@dataclass(frozen=True, slots=True)
class Blob:
    """Bytes known now, aligned as their first scalar."""

    data: bytes
    alignment: int

    @property
    def size(self) -> int:
        return len(self.data)


@dataclass(frozen=True, slots=True)
class Text:
    """A string that only the value tells; `wide` for a wstring."""

    node: ast.expr
    wide: bool
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Repeat:
    """`body` once for each of `values`, which it finds in `variable`."""

    type: List
    values: ast.expr
    variable: str
    body: tuple[Step, ...]
    span: SourceSpan


Step = Union[Put, Blob, Text, Repeat]


def scalar_format(declared: Type) -> str:
    """The struct letter of a primitive type other than a string."""
    match declared:
        case Bool():
            return "?"
        case Int():
            letter = _INTEGERS[declared.bits]
            return letter.lower() if declared.signed else letter
        case Float():
            return "f" if declared.bits == 32 else "d"
        case _:
            raise AssertionError(f"{declared} is no scalar of a ROS message")


def steps(plan: Plan) -> Iterable[Step]:  # noqa: C901 - a case a plan
    match plan:
        case Record():
            for _, member in plan.members:
                yield from steps(member)
            if not plan.type.fields:
                yield Blob(_EMPTY, 1)
        case Unset():
            yield from _default(plan.type, plan.default)
        case Leaf() if plan.constant is not None:
            yield _known(plan.constant, plan.type)
        case Leaf(type=String(wide=wide)):
            yield Text(plan.node, wide, plan.span)
        case Leaf():
            yield Put(scalar_format(plan.type), plan.node, plan.span)
        case Items():
            if plan.type.length is None:
                yield _length(len(plan.items))
            for item in plan.items:
                yield from steps(item)
        case Each():
            yield Repeat(plan.type, plan.values, plan.variable, tuple(steps(plan.element)), plan.span)


def _default(declared: Type, default: Any) -> Iterable[Step]:
    """A field that nothing fills, as rclpy's constructor leaves it; `default` is None or what its type holds."""
    match declared:
        case MessageType():
            for member in declared.fields:
                yield from _default(member.type, member.default)
            if not declared.fields:
                yield Blob(_EMPTY, 1)
        case List():
            values = [None] * (declared.length or 0) if default is None else default
            if declared.length is None:
                yield _length(len(values))
            for value in values:
                yield from _default(declared.element, value)
        case _:
            yield _known(_zero(declared) if default is None else default, declared)


def _zero(declared: Type) -> object:
    """What ROS gives a scalar field without a declared default."""
    match declared:
        case Bool():
            return False
        case Float():
            return 0.0
        case String():
            return ""
        case _:
            return 0


def _known(value: Any, declared: Type) -> Blob:
    """A value of a primitive type."""
    if isinstance(declared, String):
        data = bytearray()
        (put_wide_text if declared.wide else put_text)(data, value)
        return Blob(bytes(data), 4)
    letter = scalar_format(declared)
    return Blob(struct.pack("<" + letter, value), struct.calcsize(letter))


def _length(length: int) -> Blob:
    return Blob(struct.pack("<I", length), 4)


def message_size(plan: Record) -> tuple[int, bool]:
    """The size of the CDR bytes with header, and whether it is exact; else strings and sequences count as empty."""
    size, exact = 0, True
    for step in steps(plan):
        match step:
            case Put() | Blob():
                size += -size % step.alignment + step.size
            case Text():
                size += -size % 4 + (4 if step.wide else 5)
                exact = False
            case Repeat():
                size += -size % 4 + 4 if step.type.length is None else 0
                exact = False
    return len(HEADER) + size, exact

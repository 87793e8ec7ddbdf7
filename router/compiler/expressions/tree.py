"""The typed tree of a checked expression: the only representation of what an expression means.

Each node has the kind of its value (`kinds`) and its place in the table. Names are resolved: a node reads a variable,
or a field of a message. Computation element by element is an Each, with its lists and the expression for one element.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from enum import Enum as Enumeration
from typing import Union, get_args

from router.compiler.expressions.kinds import IntKind, Kind, ListKind
from router.errors import SourceSpan
from router.types.model import Field

MESSAGE, SOURCE, RECEIVED_AT = "message", "source", "received_at"
"""Variables in every expression; a field of the same name takes precedence."""

ENVELOPE = "envelope"
"""Likewise for a message from UDP: the message around the payload, without the payload."""

STATE = "state"
"""In conditions, `state.NAME` is a state of the table: a Variable of this name."""

ITEM, INDEX, COUNT, ITEMS = "item", "index", "count", "items"
"""Variables of `for_each` (the first three) and of `collect` (the last two)."""


class Operator(Enumeration):
    """Operators of one and two operands; the value is their spelling in a table."""

    NOT = "not"
    NEGATE = "-x"
    ADD = "+"
    SUBTRACT = "-"
    MULTIPLY = "*"
    DIVIDE = "/"
    FLOOR_DIVIDE = "//"
    MODULO = "%"
    POWER = "**"


class Relation(Enumeration):
    EQUAL = "=="
    UNEQUAL = "!="
    LESS = "<"
    LESS_OR_EQUAL = "<="
    GREATER = ">"
    GREATER_OR_EQUAL = ">="


@dataclass(frozen=True, slots=True)
class Constant:
    """A literal, a value of an enum, a constant of a ROS type, or arithmetic of these. Times are integers (ns)."""

    kind: Kind
    span: SourceSpan
    value: bool | int | float | str


@dataclass(frozen=True, slots=True)
class Variable:
    """The source message (MESSAGE), its ENVELOPE, another variable, or an element of an Each (`item_1`, ...)."""

    kind: Kind
    span: SourceSpan
    name: str


@dataclass(frozen=True, slots=True)
class Read:
    """A field of the message `holder`, which is a Variable, another Read, or an Element."""

    kind: Kind
    span: SourceSpan
    holder: Node
    field: Field


@dataclass(frozen=True, slots=True)
class Present:
    """Whether a payload's field that may be missing is set."""

    kind: Kind
    span: SourceSpan
    holder: Node
    field: Field


@dataclass(frozen=True, slots=True)
class Element:
    """An element of a list, by a constant index. Rejected at run time if it does not exist."""

    kind: Kind
    span: SourceSpan
    values: Node
    index: int


@dataclass(frozen=True, slots=True)
class ListLiteral:
    """A list literal."""

    kind: ListKind
    span: SourceSpan
    items: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Each:
    """A list computed element by element: `element`, for each index of the parallel `lists`.

    `lists` are pairs of a variable and the list whose elements it takes; none is an Each itself. Lists of different
    length are rejected at run time.
    """

    kind: ListKind
    span: SourceSpan
    lists: tuple[tuple[str, Node], ...]
    element: Node


@dataclass(frozen=True, slots=True)
class Unary:
    """NOT or NEGATE. With `is_checked`, a result that does not fit its kind is rejected."""

    kind: Kind
    span: SourceSpan
    operator: Operator
    operand: Node
    is_checked: bool = False


@dataclass(frozen=True, slots=True)
class Binary:
    """Arithmetic of two numbers, or ADD of two texts.

    Two integers give an integer (DIVIDE a float); otherwise both become doubles. With `is_checked`, an integer result
    that does not fit its kind is rejected.
    """

    kind: Kind
    span: SourceSpan
    operator: Operator
    left: Node
    right: Node
    is_checked: bool = False


@dataclass(frozen=True, slots=True)
class Compare:
    """`a < b <= c`. Each operand is evaluated at most once; evaluation stops at a comparison that is false."""

    kind: Kind
    span: SourceSpan
    relations: tuple[Relation, ...]
    operands: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Contains:
    """`sought in values`, or `not in`."""

    kind: Kind
    span: SourceSpan
    sought: Node
    values: Node
    is_negated: bool


@dataclass(frozen=True, slots=True)
class Logic:
    """`and` (`is_all`) or `or`. Evaluation stops at the operand that determines the result."""

    kind: Kind
    span: SourceSpan
    is_all: bool
    operands: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """`body if test else orelse`. Only one of the two is evaluated."""

    kind: Kind
    span: SourceSpan
    test: Node
    body: Node
    orelse: Node


@dataclass(frozen=True, slots=True)
class Call:
    """A call of a function of the language, or of one of CHECKS.

    `len` and `sum`, and `min` and `max` with one argument, take a whole list.
    """

    kind: Kind
    span: SourceSpan
    function: str
    arguments: tuple[Node, ...]


Node = Union[
    Constant, Variable, Read, Present, Element, ListLiteral, Each, Unary, Binary, Compare, Contains, Logic, Choice, Call
]
_NODES = get_args(Node)


def constant_of(node: Node) -> bool | int | float | str | None:
    """Return the value of a Constant, None for everything else (there is no None in the language)."""
    return node.value if isinstance(node, Constant) else None


def constant_bytes(octets: Call) -> bytes | None:
    """Return the result of a call of `octets`, if all its integers are Constants."""
    (values,) = octets.arguments
    if not isinstance(values, ListLiteral) or not all(isinstance(item, Constant) for item in values.items):
        return None
    return bytes(int(item.value) for item in values.items if isinstance(item, Constant))


def whole(number: int, span: SourceSpan) -> Constant:
    """Return an integer as a Constant."""
    return Constant(IntKind(number, number), span, number)


def parts_of(node: Node) -> Iterator[Node]:
    """Yield the direct children of a node."""
    for field in fields(node):
        yield from _nodes_of(getattr(node, field.name))


def nodes_in(node: Node) -> Iterator[Node]:
    """Yield a node and all nodes in it."""
    yield node
    for part in parts_of(node):
        yield from nodes_in(part)


def _nodes_of(value: object) -> Iterator[Node]:
    if isinstance(value, _NODES):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _nodes_of(item)


CHECKS = ("fit", "fit_text", "octets", "named", "member")
"""Functions that `conversion` wraps around a value, and that tables cannot call:

fit(x, low, high)   an integer, rejected outside two Constants
fit_text(x, most)   text or bytes, rejected if longer than `most` bytes
octets(list)        a list of integers as bytes, each rejected outside 0 to 255
named(text)         the value of the enum in `kind` with this name, rejected if there is none
member(x)           a number as a value of the closed enum in `kind`, rejected if there is no such value
"""

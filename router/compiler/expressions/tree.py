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
"""Variables that every expression can name beside the fields; a field of the same name wins."""

ITEM, INDEX, COUNT, ITEMS = "item", "index", "count", "items"
"""Variables of `for_each` (the first three) and of `collect` (the last two)."""


class Operator(Enumeration):
    """Operators of one and two operands; the value is how the table spells them."""

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
    MORE = ">"
    MORE_OR_EQUAL = ">="


@dataclass(frozen=True, slots=True)
class Constant:
    """A literal, a value of an enum, a constant of a ROS type, or arithmetic of such. Times are integers (ns)."""

    kind: Kind
    span: SourceSpan
    value: bool | int | float | str


@dataclass(frozen=True, slots=True)
class Variable:
    """The source message (MESSAGE), what stands beside it, or an element of an Each (`item_1`, ...)."""

    kind: Kind
    span: SourceSpan
    name: str


@dataclass(frozen=True, slots=True)
class Read:
    """A field of the message that `holder` is: a Variable, another Read, or an Element."""

    kind: Kind
    span: SourceSpan
    holder: Node
    field: Field


@dataclass(frozen=True, slots=True)
class Present:
    """Whether a payload has a field that can be missing."""

    kind: Kind
    span: SourceSpan
    holder: Node
    field: Field


@dataclass(frozen=True, slots=True)
class Element:
    """An element of a list, by a constant index. Refused at run time if there is none."""

    kind: Kind
    span: SourceSpan
    values: Node
    index: int


@dataclass(frozen=True, slots=True)
class Listed:
    """A list literal."""

    kind: ListKind
    span: SourceSpan
    items: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Each:
    """A list computed element by element: `element`, for the elements of `lists` side by side.

    `lists` are pairs of a variable and the list whose elements it takes; none is an Each itself. Lists of different
    length are refused at run time.
    """

    kind: ListKind
    span: SourceSpan
    lists: tuple[tuple[str, Node], ...]
    element: Node


@dataclass(frozen=True, slots=True)
class Unary:
    """NOT or NEGATE. `is_checked`: a result that does not fit its kind is refused."""

    kind: Kind
    span: SourceSpan
    operator: Operator
    operand: Node
    is_checked: bool = False


@dataclass(frozen=True, slots=True)
class Binary:
    """Arithmetic of two numbers, or ADD of two texts.

    Two integers give an integer (DIVIDE a float); otherwise both become doubles. `is_checked`: an integer result that
    does not fit its kind is refused.
    """

    kind: Kind
    span: SourceSpan
    operator: Operator
    left: Node
    right: Node
    is_checked: bool = False


@dataclass(frozen=True, slots=True)
class Compare:
    """`a < b <= c`. Each operand is evaluated at most once, and none after a comparison that is false."""

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
    """`and` (`is_all`) or `or`. Evaluation stops at the operand that decides."""

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
    Constant, Variable, Read, Present, Element, Listed, Each, Unary, Binary, Compare, Contains, Logic, Choice, Call
]
_NODES = get_args(Node)


def constant_of(node: Node) -> bool | int | float | str | None:
    """The value of a Constant, None for everything else (there is no None in the language)."""
    return node.value if isinstance(node, Constant) else None


def constant_bytes(octets: Call) -> bytes | None:
    """What a call of `octets` gives, if all its integers are Constants."""
    (values,) = octets.arguments
    if not isinstance(values, Listed) or not all(isinstance(item, Constant) for item in values.items):
        return None
    return bytes(int(item.value) for item in values.items if isinstance(item, Constant))


def whole(number: int, span: SourceSpan) -> Constant:
    """An integer."""
    return Constant(IntKind(number, number), span, number)


def parts_of(node: Node) -> Iterator[Node]:
    """The nodes directly in this one."""
    for each in fields(node):
        yield from _nodes_of(getattr(node, each.name))


def _nodes_of(value: object) -> Iterator[Node]:
    if isinstance(value, _NODES):
        yield value
    elif isinstance(value, tuple):
        for each in value:
            yield from _nodes_of(each)


CHECKS = ("fit", "fit_text", "octets", "named", "member")
"""Functions that `conversion` puts around a value, and that tables cannot call:

fit(x, low, high)   an integer, refused outside of two Constants
fit_text(x, most)   text or bytes of at most so many bytes
octets(list)        a list of integers as bytes, each refused outside of 0 to 255
named(text)         the value of the enum in `kind` that has this name, refused if none has
member(x)           a number as a value of the closed enum in `kind`, refused if it has no such value
"""

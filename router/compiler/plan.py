"""The plan of a message: a tree of the same structure, with the origin of each field's value.

`mapping` makes plans; `lowering` turns them into routines of the machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Union

from router.compiler.expressions.tree import Call, Node, constant_bytes, constant_of
from router.errors import SourceSpan
from router.types.model import Field, List, MessageType, Type


@dataclass(frozen=True, slots=True)
class Leaf:
    """A scalar, computed by `node`; `constant` is its value if that is known at compile time."""

    type: Type
    node: Node
    span: SourceSpan

    @property
    def constant(self) -> bool | int | float | str | bytes | None:
        if isinstance(self.node, Call) and self.node.function == "octets":
            return constant_bytes(self.node)
        return constant_of(self.node)


@dataclass(frozen=True, slots=True)
class Record:
    """A message: a plan for each of its fields, in order."""

    type: MessageType
    members: tuple[tuple[Field, Plan], ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Items:
    """A list with a plan for each element."""

    type: List
    items: tuple[Plan, ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Each:
    """A list filled from one or more parallel lists (or bytes): `element` fills one element.

    `lists` are pairs of a variable and the list whose elements it takes. Lists of different length are rejected at run
    time.
    """

    type: List
    lists: tuple[tuple[str, Node], ...]
    element: Plan
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Unset:
    """An unfilled field: it keeps its default, or stays absent in protobuf."""

    type: Type
    default: object
    span: SourceSpan


Plan = Union[Leaf, Record, Items, Each, Unset]

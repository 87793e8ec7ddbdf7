"""The plan of a message: a tree like the message, which says of each field where its value comes from.

`mapping` makes plans, which fit their types; how they are written (CDR, protobuf) is for others.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import Union

from router.errors import SourceSpan
from router.types.model import Field, List, MessageType, Type


@dataclass(frozen=True, slots=True)
class Leaf:
    """One scalar. `constant` is its value where that is known now, else `node` computes it."""

    type: Type
    node: ast.expr
    span: SourceSpan

    @property
    def constant(self) -> object:
        return self.node.value if isinstance(self.node, ast.Constant) else None


@dataclass(frozen=True, slots=True)
class Record:
    """A message: a plan for each of its fields, in order."""

    type: MessageType
    members: tuple[tuple[Field, Plan], ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Items:
    """A list whose elements are each known by themselves."""

    type: List
    items: tuple[Plan, ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Each:
    """A list made of a list (or bytes): `element` fills one element from the one called `variable`."""

    type: List
    values: ast.expr
    variable: str
    element: Plan
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Unset:
    """A field that nothing fills: it keeps its default, or in protobuf stays absent."""

    type: Type
    default: object
    span: SourceSpan


Plan = Union[Leaf, Record, Items, Each, Unset]

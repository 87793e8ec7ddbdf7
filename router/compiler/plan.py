"""The plan of a message: a tree with its structure that says where the value of each field comes from.

`mapping` makes plans; `cdr.writing` and `payload` generate code of them.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import Union

from router.errors import SourceSpan
from router.types.model import Field, List, MessageType, Type


@dataclass(frozen=True, slots=True)
class Leaf:
    """One scalar, which `node` computes; `constant` is its value if that is known at compile time."""

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
    """A list with a plan for each element."""

    type: List
    items: tuple[Plan, ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Each:
    """A list made of a list (or bytes) `values`: `element` fills one element from the variable `variable`."""

    type: List
    values: ast.expr
    variable: str
    element: Plan
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Unset:
    """A field that nothing fills: it keeps its default, or stays absent in protobuf."""

    type: Type
    default: object
    span: SourceSpan


Plan = Union[Leaf, Record, Items, Each, Unset]

"""A checked target: what the check of a route hands to the generation of its code."""

from __future__ import annotations

from dataclasses import dataclass

from router.compiler.expressions import Locals, Typed
from router.compiler.plan import Record
from router.errors import SourceSpan


@dataclass(frozen=True, slots=True)
class Target:
    """A destination, or with a `plan` a topic. `name` is its label in the books."""

    name: str
    span: SourceSpan
    locals: Locals
    when: Typed | None = None
    max_rate: float | None = None
    trim: bool = False
    plan: Record | None = None

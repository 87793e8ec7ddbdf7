"""A checked target: what the check of a route hands to the generation of its code."""

from __future__ import annotations

from dataclasses import dataclass

from router.compiler.expressions import Reads, Typed
from router.compiler.plan import Record
from router.errors import SourceSpan
from router.table.model import Keep, Priority


@dataclass(frozen=True, slots=True)
class Target:
    """A destination or a topic. `name` is its label in the counters. Without a `plan` the datagram is forwarded.

    `reads` makes the variables of its expressions; None where they are made once for all targets of the route.
    `deadmen` are the routes whose deadmen hear of each command to it.
    """

    name: str
    span: SourceSpan
    is_topic: bool
    reads: Reads | None
    when: Typed | None = None
    max_rate: float | None = None
    keep: Keep = Keep.FIRST
    priority: Priority = Priority.TELEMETRY
    has_budget: bool = False
    trim: bool = False
    plan: Record | None = None
    deadmen: tuple[str, ...] = ()

    @property
    def is_deferred(self) -> bool:
        """Whether it may be served later, and by another thread."""
        return self.has_budget or self.keep is Keep.LATEST

"""How simulated endpoints reply to the requests of services."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from router.compiler.compiled_table import ServicePlan
from router.compiler.expressions.tree import ENVELOPE
from router.datagrams import Decoded, Wire
from router.table.model import RouteTable
from router.types.protobuf import PayloadCase


@dataclass(frozen=True, slots=True)
class Reply:
    """The payload case with which `endpoint` replies to each `request` that `asked` gets. `match` as in ServicePlan."""

    asked: str
    request: str
    endpoint: str
    case: PayloadCase
    match: tuple[str, ...] | None

    def copy_number(self, request: Decoded, message: Any, around: Any) -> None:
        """Copy the field `match` from a request to a reply: its payload, or its envelope without the payload."""
        if self.match is None:
            return
        is_beside = self.match[0] == ENVELOPE
        source: Any = request.beside if is_beside else request.message
        target = around if is_beside else message
        *way, last = self.match[is_beside:]
        for name in way:
            source, target = getattr(source, name), getattr(target, name)
        setattr(target, last, getattr(source, last))


def replies(wire: Wire, table: RouteTable, plans: Iterable[ServicePlan]) -> Iterator[Reply]:
    """Yield one reply for each payload case that answers a request of an endpoint, though of several services."""
    found = set()
    for plan in plans:
        request, (case, sender) = table.services[plan.name].request.case.value, plan.group
        if (key := (plan.endpoint, request, sender, case)) not in found:
            found.add(key)
            yield Reply(plan.endpoint, request, sender, wire.case(case), plan.match)

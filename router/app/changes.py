"""What a reload changes, in a line, and what of it a running router cannot take over.

Names what is written in another way, which is what is wired anew; `router explain --diff` shows how.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from router.compiler.program import Program
from router.errors import Code, Diagnostic, SourceSpan
from router.table.keys import are_same
from router.table.model import NodeSettings, RouteTable

_MOST_NAMED = 12


def unchangeable(now: RouteTable, then: RouteTable) -> list[Diagnostic]:
    """A finding for each setting of `then` that only a start can take over."""
    top = SourceSpan(str(then.path))
    settings = {
        "node": (_node(now.node), _node(then.node), then.node.span),
        "metrics": (now.metrics, then.metrics, then.metrics and then.metrics.span),
        "record": (now.record, then.record, then.record and then.record.span),
        "foxglove": (now.foxglove, then.foxglove, then.foxglove and then.foxglove.span),
    }
    return [
        Diagnostic(
            span or top, Code.BAD_VALUE, f"'{key}' cannot change while the router runs", "restart it, or change it back"
        )
        for key, (before, after, span) in settings.items()
        if not are_same(before, after)
    ]


def _node(node: NodeSettings) -> object:
    return node.name, node.namespace, node.diagnostics is not None


def changes(before: Program, after: Program) -> str:
    """`route imu_info changed, endpoint arm_board added`; of many the first."""
    now, then = before.table, after.table
    found = [
        *_differing("listener", now.listeners, then.listeners),
        *_differing("endpoint", now.endpoints, then.endpoints),
        *_differing("route", _routes(now), _routes(then)),
        *_differing("gateway", now.gateways, then.gateways),
        *(["protos changed"] if before.protos_sha256 != after.protos_sha256 else []),
    ]
    if not found:
        return "nothing changed"
    named, others = found[:_MOST_NAMED], len(found) - _MOST_NAMED
    return ", ".join([*named, *([f"and {others} more"] if others > 0 else [])])


def all_moved(now: RouteTable, then: RouteTable) -> list[str]:
    """`sensor_board 127.0.0.30:8 -> 192.168.0.30:8` for each endpoint that both have, if none is where it was."""
    both = [
        (name, endpoint.address.value, then.endpoints[name].address.value)
        for name, endpoint in now.endpoints.items()
        if name in then.endpoints
    ]
    if any(before == after for _, before, after in both):
        return []
    return [f"{name} {before} -> {after}" for name, before, after in both]


def _routes(table: RouteTable) -> Mapping[str, object]:
    return {route.name: route for route in table.routes}


def _differing(kind: str, now: Mapping[str, object], then: Mapping[str, object]) -> Iterator[str]:
    for name in [*now, *(then.keys() - now.keys())]:
        if name not in now:
            yield f"{kind} {name} added"
        elif name not in then:
            yield f"{kind} {name} removed"
        elif not are_same(now[name], then[name]):
            yield f"{kind} {name} changed"

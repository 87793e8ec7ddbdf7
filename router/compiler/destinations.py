"""Endpoints that a route sends to: which they are, whether they can take the payload, and the targets they become."""

from __future__ import annotations

from collections.abc import Set as AbstractSet

from router.compiler.expressions import Reads, Typed
from router.compiler.lookup import Lookup
from router.compiler.network import loop_finding
from router.compiler.plan import Record
from router.compiler.target import Target
from router.errors import Code
from router.table.model import Deadman, Destination, Endpoint, EndpointKind, Keep, Located, Priority, Route, Topic
from router.types.boards import board_findings
from router.types.protobuf import PayloadCase


def destinations(lookup: Lookup, route: Route, case: PayloadCase) -> list[tuple[Destination, Endpoint | None]]:
    """Those of a route, each with its endpoint, None where there is none; what is wrong with them is reported."""
    sources = {source.value for source in route.sources}
    seen: set[str] = set()
    for destination in route.destinations:
        name = destination.endpoint
        if name.value in seen:
            lookup.report(name.span, Code.BAD_VALUE, f"'{name.value}' is a destination twice", "name it once")
        seen.add(name.value)
    return [(each, recipient(lookup, case, each.endpoint, sources)) for each in route.destinations]


def recipient(lookup: Lookup, case: PayloadCase, name: Located[str], sources: AbstractSet[str]) -> Endpoint | None:
    """The endpoint `name`, which gets payloads of `case` that come from `sources`; None where there is none."""
    endpoint = lookup.endpoint(name)
    if endpoint is None:
        return None
    finding = loop_finding(lookup.table, endpoint, name.span, case.name, sources)
    if finding and finding.message not in {earlier.message for earlier in lookup.findings}:
        lookup.findings.append(finding)  # an endpoint that is the router itself is one mistake, not one per route
    if endpoint.kind is EndpointKind.BOARD:
        lookup.findings += board_findings(case, lookup.schema, lookup.board_limit, name.span)
    return endpoint


def feeding(route: Route, deadman: Deadman) -> list[Destination]:
    """The destinations that commands have to reach for a route's own deadman: those that it stops.

    Where it stops others than the route commands, all of the route's.
    """
    stopped = {to.value for to in deadman.to}
    return [each for each in route.destinations if each.endpoint.value in stopped] or list(route.destinations)


def takes_over(route: Route, endpoint: str, other: Route) -> bool:
    """Whether a command of `route` to `endpoint` disarms the deadman of the `other` route."""
    deadman = other.deadman
    return (
        deadman is not None
        and other.name != route.name
        and route.case.value in [case.value for case in deadman.hands_over_to]
        and endpoint in [to.value for to in deadman.to]
    )


def target_to(
    lookup: Lookup,
    route: Route,
    destination: Destination,
    endpoint: Endpoint | None,
    when: Typed | None,
    reads: Reads | None = None,
    plan: Record | None = None,
) -> Target:
    """The target that a destination becomes. Whatever goes to a board is a command where the route says nothing."""
    to_board = endpoint is not None and endpoint.kind is EndpointKind.BOARD
    name = destination.endpoint.value
    deadmen = [other.name for other in lookup.table.routes if takes_over(route, name, other)]
    if route.deadman is not None and destination in feeding(route, route.deadman):
        deadmen.insert(0, route.name)
    return Target(
        name=name,
        span=destination.span,
        is_topic=False,
        reads=reads,
        when=when,
        max_rate=max_rate(destination),
        keep=keep(destination),
        priority=route.priority.value if route.priority else Priority.COMMAND if to_board else Priority.TELEMETRY,
        has_budget=endpoint is not None and endpoint.budget is not None,
        trim=endpoint is not None and endpoint.trim_trailing_zeros,
        plan=plan,
        deadmen=tuple(deadmen),
    )


def max_rate(limited: Destination | Topic) -> float | None:
    return limited.max_rate.value if limited.max_rate else None


def keep(limited: Destination | Topic) -> Keep:
    return limited.keep.value if limited.keep else Keep.FIRST

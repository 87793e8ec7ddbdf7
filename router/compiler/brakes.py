"""Checks brakes across all routes: a board takes what a deadman sends, and no old command follows it.

`deadmen` checks each deadman by itself.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from router.compiler.checked import CheckedRoute
from router.compiler.topics import qos_of, resolved
from router.errors import Code, Diagnostic, SourceSpan
from router.table.model import RouteTable
from router.table.model.endpoints import EndpointKind
from router.table.model.routes import Deadman, Route
from router.table.model.targets import Topic
from router.table.units import duration

USUAL_TTL = 200_000_000
"""The `ttl` in hints, in ns."""
_LATCHED = ("transient_local", "best_available")
"""Durabilities with which a new subscription receives earlier messages."""


def brake_findings(table: RouteTable, routes: Sequence[CheckedRoute]) -> Iterator[Diagnostic]:
    """Yield warnings for deadmen that no board may obey, and for commands that may be of any age."""
    boards = {name for name, endpoint in table.endpoints.items() if endpoint.kind is EndpointKind.BOARD}
    taken = _taken(table, routes, boards)
    for checked in routes:
        route = checked.route
        if f"routes/{route.case.value}" in table.broken:
            continue
        if route.deadman is not None and checked.deadman is not None and route.destinations:
            yield from _unheard(table, route, route.deadman, taken)
        if route.ttl is None and route.no_ttl is None:
            yield from _any_age(checked)
    yield from _any_age_of_clients(table, boards)


# What boards take


def _taken(table: RouteTable, routes: Sequence[CheckedRoute], boards: Collection[str]) -> Mapping[str, Sequence[str]]:
    """Return the payload cases that routes send to each board; of one with another envelope, under both names."""
    by_board: dict[str, dict[str, None]] = {name: {} for name in table.endpoints if name in boards}
    for route in table.routes:
        for destination in route.destinations:
            if destination.endpoint.value in by_board:
                by_board[destination.endpoint.value][route.case.value] = None
    rewrapped = ((target.label, target.rewrapped) for checked in routes for target in checked.all_targets)
    for name, held in rewrapped:
        if held is not None and name in by_board:
            by_board[name][held.name] = None
    return {name: [*cases] for name, cases in by_board.items()}


def _unheard(
    table: RouteTable, route: Route, deadman: Deadman, taken: Mapping[str, Sequence[str]]
) -> Iterator[Diagnostic]:
    """Yield warnings if a deadman sends to no board, or sends what its boards never get otherwise.

    One payload that a board takes is enough for that board. A deadman that leaves out a board of its route has another
    finding.
    """
    names = [to.value for to in deadman.to]
    cases = [payload.case for payload in deadman.payloads]
    if deadman.because is not None or not table.endpoints.keys() >= {*names}:
        return  # it is intended, or there is a finding already
    boards = [name for name in names if name in taken]
    if not boards and taken.keys().isdisjoint(destination.endpoint.value for destination in route.destinations):
        takers = [name for name, of_board in taken.items() if any(case.value in of_board for case in cases)]
        message = f"the deadman stops nothing: it sends to '{names[0]}', which is not a board"
        yield _doubtful(deadman.to[0].span, message, f"set `to: {_flow(takers)}`" if takers else "name boards in `to`")
    if not boards or any(f"routes/{case.value}" in table.broken for case in cases):
        return
    for_none = [case for case in cases if not any(case.value in taken[name] for name in boards)]
    with_none = [name for name in boards if not any(case.value in taken[name] for case in cases)]
    for case in for_none or (cases[:1] if with_none else []):
        board = (with_none or boards)[0]
        message = f"no route sends '{case.value}' to '{board}', so its firmware may ignore it"
        remedy = f"send what it gets ({', '.join(taken[board])})" if taken[board] else "add a route that does"
        yield _doubtful(case.span, message, remedy)


def _doubtful(span: SourceSpan, message: str, remedy: str) -> Diagnostic:
    return Diagnostic(span, Code.DOUBTFUL_DEADMAN, message, f"{remedy}, or add `because: why`")


def _flow(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"[{', '.join(names)}]"


# How old commands are


def _any_age(checked: CheckedRoute) -> Iterator[Diagnostic]:
    """Yield a warning if a route without `ttl` could release a deadman with an old command, or send one at the start.

    Commands that wait in the router have another finding.
    """
    route = checked.route
    targets = [*checked.targets, *(target for topic in checked.subscriptions for target in topic.targets)]
    others = [name for target in targets for name in target.deadmen if name != route.name]
    if route.deadman is not None:
        if route.destinations and not any(target.is_deferred for target in targets):
            message = "commands that waited in a socket or a stopped process are sent after the deadman's payload"
            yield _no_ttl(route.deadman.span, message, min(USUAL_TTL, route.deadman.timeout.value))
    elif others:
        message = f"commands that waited in a socket or a stopped process disarm the deadman of '{others[0]}'"
        yield _no_ttl(route.span, message, USUAL_TTL)
    else:
        yield from _latched(checked)


def _latched(checked: CheckedRoute) -> Iterator[Diagnostic]:
    """Yield a warning for the first topic whose last message is sent to a board when the router starts."""
    for subscription in checked.subscriptions:
        topic, boards = subscription.topic, [target.label for target in subscription.targets if target.is_command]
        if boards and qos_of(topic).durability in _LATCHED:
            message = f"the last message of '{topic.topic.value}' is sent to '{boards[0]}' at the start, however old"
            yield _no_ttl(_durability(topic), message, USUAL_TTL)
            return


def _durability(topic: Topic) -> SourceSpan:
    """Return the place that makes a topic's messages outlive their publication."""
    setting = (topic.qos.durability or topic.qos.profile) if topic.qos else None
    return setting.span if setting else topic.span


def _any_age_of_clients(table: RouteTable, boards: Collection[str]) -> Iterator[Diagnostic]:
    """Yield a warning for each topic without `ttl` on which clients of gateways publish commands."""
    sent_to = _sent_to(table, boards)
    for gateway in table.gateways.values():
        for inbound in gateway.inbound if f"gateways/{gateway.name}" not in table.broken else ():
            if inbound.ttl is not None or inbound.no_ttl is not None:
                continue
            name = inbound.topic.topic
            if inbound.deadman is not None:
                message = "messages that waited on a client's link are published after the deadman's message"
                yield _no_ttl(inbound.deadman.span, message, min(USUAL_TTL, inbound.deadman.timeout.value), _CLIENTS)
            elif board := sent_to.get(resolved(name.value, table.node)):
                message = f"messages that waited on a client's link are sent to '{board}', whatever the route's `ttl`"
                yield _no_ttl(name.span, message, USUAL_TTL, _CLIENTS)


def _sent_to(table: RouteTable, boards: Collection[str]) -> Mapping[str, str]:
    """Return a board for each topic, by absolute name, whose messages a route sends to boards."""
    by_topic: dict[str, str] = {}
    for route in table.routes:
        for board in (to.endpoint.value for to in route.destinations if to.endpoint.value in boards):
            for topic in route.source_topics:
                by_topic.setdefault(resolved(topic.topic.value, table.node), board)
    return by_topic


_CLIENTS = " to the topic, which counts from the `time` of the client"


def _no_ttl(span: SourceSpan, message: str, ttl: int, where: str = "") -> Diagnostic:
    hint = f"add `ttl: {duration(ttl).replace(' ', '')}`{where}, or `ttl: {{none: why}}` if old ones do no harm"
    return Diagnostic(span, Code.NO_TTL, message, hint)

"""Which commands feed and disarm which deadmen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace

from router.compiler.constants import envelope_of
from router.compiler.lookup import Lookup
from router.compiler.mapping import build
from router.errors import Code, FindingError, did_you_mean
from router.table.model.expressions import FieldMap
from router.table.model.routes import Deadman, Route
from router.table.model.targets import Destination
from router.types.model import MessageType

_NOTHING = MessageType("nothing")
"""A message without fields."""


def feeding(route: Route, deadman: Deadman) -> list[Destination]:
    """Return the destinations whose commands feed a route's own deadman: those that the deadman stops.

    If the route does not send to any of these, return all of its destinations.
    """
    stopped = {to.value for to in deadman.to}
    return [to for to in route.destinations if to.endpoint.value in stopped] or list(route.destinations)


def takes_over(route: Route, endpoint: str, other: Route) -> bool:
    """Return whether a command of `route` to `endpoint` disarms the deadman of the `other` route for that endpoint."""
    deadman = other.deadman
    return (
        deadman is not None
        and other.name != route.name
        and any(name.value in (route.case.value, route.name) for name in deadman.disarmed_by or ())
        and endpoint in [to.value for to in deadman.to]
    )


def deadmen_of(lookup: Lookup, route: Route, destination: Destination) -> tuple[str, ...]:
    """Return the routes whose deadmen each command to `destination` feeds or disarms, its own route first."""
    names = (route.case.value, route.name)
    disarmed = dict.fromkeys(other.name for name in names for other in lookup.disarmed.get(name, ()))
    others = [name for name in disarmed if takes_over(route, destination.endpoint.value, lookup.routes[name])]
    feeds_own = route.deadman is not None and destination in feeding(route, route.deadman)
    return (route.name, *others) if feeds_own else tuple(others)


def successors(lookup: Lookup, route: Route, deadman: Deadman) -> tuple[str, ...]:
    """Return the routes whose commands disarm the deadman. Report names in `disarmed_by` without such a route."""
    table = lookup.table
    others = [
        other for other in table.routes if any(takes_over(other, to.endpoint.value, route) for to in other.destinations)
    ]
    served = {name for other in others for name in (other.case.value, other.name)}
    broken = [name.removeprefix("routes/") for name in table.broken if name.startswith("routes/")]
    are_known = all(to.value in table.endpoints for to in deadman.to)  # otherwise there is a finding already
    for name in deadman.disarmed_by or ():
        if name.value in broken or any(name.value.startswith(f"{case}_from_") for case in broken):
            continue
        if name.value not in lookup.envelopes.cases and name.value not in lookup.routes:
            message = f"'{name.value}' is neither a payload case of {lookup.envelopes.title} nor a route"
            hint = did_you_mean(name.value, _commanding(lookup, route, deadman) or lookup.envelopes.cases)
            lookup.report(name.span, Code.UNKNOWN_PAYLOAD_CASE, message, hint)
        elif name.value not in served and are_known:
            to = " or ".join(f"'{to.value}'" for to in deadman.to)
            message = f"no other route sends '{name.value}' to {to}, so it cannot disarm this deadman"
            nobody = f"remove it: no other route sends commands to {to}"
            hint = did_you_mean(name.value, _commanding(lookup, route, deadman)) or nobody
            lookup.report(name.span, Code.BAD_VALUE, message, hint)
    return tuple(other.name for other in others)


def _commanding(lookup: Lookup, route: Route, deadman: Deadman) -> set[str]:
    """Return the payload cases and names of other routes to the endpoints of the deadman."""
    others = [other for other in lookup.table.routes if other.name != route.name and _shared(other, deadman)]
    return {name for other in others for name in (other.case.value, other.name)}


def _shared(route: Route, deadman: Deadman) -> list[str]:
    """Return the endpoints of the deadman that the route commands."""
    stopped = {to.value for to in deadman.to}
    return [to.endpoint.value for to in route.destinations if to.endpoint.value in stopped]


# `disarmed_by` that is missing


def require_hand_over(lookup: Lookup, route: Route, deadman: Deadman) -> None:
    """Report routes with a deadman whose commands to a board this deadman would interrupt."""
    if deadman.disarmed_by == ():
        return
    forgotten: dict[str, str] = {}
    """A board that each route commands, by the route's name."""
    for other in lookup.table.routes:
        shared = [name for name in _shared(other, deadman) if name in lookup.boards]
        if shared and other.deadman and other.name != route.name and not takes_over(other, shared[0], route):
            forgotten[other.name] = shared[0]
    if not forgotten:
        return
    name, board = next(iter(forgotten.items()))
    message = f"the deadman would interrupt commands of '{_written(lookup, name)}', which '{board}' also receives"
    span = deadman.disarmed_by[0].span if deadman.disarmed_by else deadman.span
    lookup.report(span, Code.DOUBTFUL_DEADMAN, message, _remedy(lookup, route, deadman, forgotten))


def _remedy(lookup: Lookup, route: Route, deadman: Deadman, forgotten: Mapping[str, str]) -> str:
    # Commands to another motor must not disarm this deadman: it would stay silent as long as they arrive.
    beside = "`because: why`" if deadman.disarmed_by else "`disarmed_by: []`"
    others = [lookup.routes[name] for name in forgotten]
    unstopped = next((other for other in others if not _stops(other, forgotten[other.name])), None)
    if unstopped is not None:  # disarmed by its commands, no deadman would stop the board when they end
        board, name = forgotten[unstopped.name], _written(lookup, unstopped.name)
        return (
            f"add {beside} if they move other motors; if '{name}' takes over from '{route.case.value}', first add "
            f"'{board}' to `to` of its deadman, which does not stop it"
        )
    named = [name.value for name in deadman.disarmed_by or ()]
    names = dict.fromkeys((*named, *(_written(lookup, name) for name in forgotten)))
    value = f"[{', '.join(names)}]" if len(names) > 1 else next(iter(names))
    for other in others:
        if (field := _difference(lookup, route, other, forgotten[other.name])) is not None:
            return (
                f"add {beside} if they move other motors, as '{field}' suggests, which differs in commands of "
                f"'{other.name}'; or `disarmed_by: {value}` if they take over from '{route.name}'"
            )
    return (
        f"add `disarmed_by: {value}` if they take over from '{route.case.value}', or {beside} if they move other motors"
    )


def _stops(route: Route, board: str) -> bool:
    return route.deadman is not None and board in [to.value for to in route.deadman.to]


def _written(lookup: Lookup, name: str) -> str:
    """Return how to name a route in `disarmed_by`: by its case, unless there are several routes of this case."""
    case = lookup.routes[name].case.value
    return name if sum(route.case.value == case for route in lookup.table.routes) > 1 else case


def _difference(lookup: Lookup, route: Route, other: Route, board: str) -> str | None:
    """Return a field that commands of two routes of one case to a board set to different constants, or None."""
    if route.case.value != other.case.value:
        return None
    ours, theirs = (dict(_constants(lookup, one, board)) for one in (route, other))
    return next((name for name in ours if name in theirs and ours[name] != theirs[name]), None)


def _constants(lookup: Lookup, route: Route, board: str) -> Iterator[tuple[str, bytes]]:
    """Yield the fields that are constants in the route's commands to a board, each with its encoding."""
    case = lookup.envelopes.cases.get(route.case.value)
    if case is None:
        return
    scope = replace(lookup.scope(_NOTHING, None), given=())
    for fields in _field_maps(route, board):
        for entry in fields.entries:
            alone = FieldMap(fields.span, auto=False, entries=(entry,))
            mapping = build(alone, case.type, scope, fields.span)
            if mapping.plan is not None and not mapping.findings:
                with suppress(FindingError):  # the machine drops the message, or it is reported with the route
                    yield ".".join(entry.path), envelope_of(mapping.plan, case)


def _field_maps(route: Route, board: str) -> Iterable[FieldMap]:
    to = [destination.fields for destination in route.destinations if destination.endpoint.value == board]
    return [fields for fields in (route.fields, *(topic.fields for topic in route.source_topics), *to) if fields]

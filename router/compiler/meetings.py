"""Routes and gateways that meet: at a source, which one route may have, and on a topic, where all must understand
each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from router.compiler.program import QosPlan
from router.compiler.topics import qos_of, resolved, topic_name_finding
from router.errors import Code, Diagnostic, SourceSpan
from router.table.model import ANY, InboundDeadman, Located, Route, RouteTable, Topic


def clash_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Routes of one payload case that take it from the same endpoint, or from the same topic."""
    earlier: dict[str, dict[str, SourceSpan]] = {}
    for route in table.routes:
        taken = earlier.setdefault(route.case.value, {})
        origins = _origins(route, table)
        for key, origin in origins.items():
            if (name := _taken(key, taken)) is not None:
                message = f"another route takes '{route.case.value}' from '{name}'"
                yield Diagnostic(origin.span, Code.SOURCE_CLASH, message, f"see {taken[name]}; let one have it")
        taken.update((key, origin.span) for key, origin in origins.items())


def _origins(route: Route, table: RouteTable) -> dict[str, Located[str]]:
    """Where a route takes messages from: topics by their absolute names, which no endpoint has, or endpoints."""
    if route.is_outbound:
        return {resolved(topic.topic.value, table.node): topic.topic for topic in route.topics}
    return {source.value: source for source in route.sources}


def _taken(key: str, taken: Mapping[str, SourceSpan]) -> str | None:
    """What of `taken` stands in the way. `any` overlaps with all endpoints."""
    if key in taken:
        return key
    if key == ANY:
        return next((name for name in taken if not name.startswith("/")), None)
    return ANY if ANY in taken and not key.startswith("/") else None


@dataclass(frozen=True, slots=True)
class _Use:
    """One mention of a topic in the table. `owner` is how sentences call the route or gateway that names it."""

    topic: Topic
    owner: str
    publishes: bool
    qos: QosPlan
    route: Route | None = None
    deadman: InboundDeadman | None = None


def topic_findings(table: RouteTable, routes: Sequence[Route]) -> Iterator[Diagnostic]:
    """Topics that several name: one type, one QoS for each direction, QoS that matches, no way back, and no deadman
    that meets the messages of others.

    Of a gateway these are the topics that its clients publish on.
    """
    for name, uses in _uses(table, routes).items():
        firsts = [uses[0], *[use for use in uses if use.publishes != uses[0].publishes][:1]]
        for use in uses[1:]:
            found = (_disagreement(name, first, use) for first in firsts if first is not use)
            if finding := next(filter(None, found), None):
                yield finding
        for publisher, subscriber in product(uses, uses):
            if publisher.publishes and not subscriber.publishes and publisher.route and subscriber.route:
                yield from _echoes(name, publisher.route, subscriber.route)
        for use in uses:
            yield from _struggles(name, use, uses)


def _uses(table: RouteTable, routes: Sequence[Route]) -> Mapping[str, Sequence[_Use]]:
    """By absolute name."""
    uses: dict[str, list[_Use]] = {}
    for use in _all_uses(table, routes):
        if topic_name_finding(use.topic) is None:
            uses.setdefault(resolved(use.topic.topic.value, table.node), []).append(use)
    return uses


def _all_uses(table: RouteTable, routes: Sequence[Route]) -> Iterator[_Use]:
    for route in routes:
        for topic in route.topics:
            yield _Use(topic, f"route '{route.name}'", not route.is_outbound, qos_of(topic), route)
    for gateway in table.gateways.values():
        for inbound in gateway.inbound:
            owner = f"gateway '{gateway.name}'"
            yield _Use(inbound.topic, owner, True, qos_of(inbound.topic), deadman=inbound.deadman)


def _echoes(name: str, publisher: Route, subscriber: Route) -> Iterator[Diagnostic]:
    """Endpoints that would get back through a topic what they sent themselves."""
    sources = {source.value for source in publisher.sources}
    for destination in subscriber.destinations:
        sender = destination.endpoint
        if sender.value in sources:
            message = f"'{sender.value}' would get its own '{publisher.case.value}' back through the topic '{name}'"
            hint = "remove it from the destinations, or give one of the routes another topic"
            yield Diagnostic(sender.span, Code.FORWARDING_LOOP, message, hint)


def _struggles(name: str, use: _Use, others: Sequence[_Use]) -> Iterator[Diagnostic]:
    """A gateway's deadman knows only its own clients: it publishes against others, and feeds the deadmen of routes."""
    if use.deadman is None:
        return
    for other in others:
        if other.publishes and other.owner != use.owner:
            message = f"while clients of {use.owner} are silent, this would publish on '{name}' against {other.owner}"
            hint = "give each a topic of its own, and let a node choose between them, such as twist_mux"
        elif other.route is not None and other.route.deadman is not None and not other.publishes:
            message = f"{other.owner} takes '{name}', and this would keep its deadman from tripping"
            hint = "leave it to the route"
        else:
            continue
        yield Diagnostic(use.deadman.span, Code.BAD_VALUE, message, hint)
        return


def _disagreement(name: str, first: _Use, use: _Use) -> Diagnostic | None:
    if use.topic.type.value != first.topic.type.value:
        message = f"topic '{name}' has the type {first.topic.type.value} in {first.owner}"
        hint = f"a topic has one type; see {first.topic.type.span}"
        return Diagnostic(use.topic.type.span, Code.TOPIC_TYPE_CLASH, message, hint)
    span = use.topic.qos.span if use.topic.qos else (use.topic.queue_depth or use.topic.topic).span
    if use.publishes == first.publishes:
        if use.qos == first.qos:
            return None
        message = f"topic '{name}' has another QoS in {first.owner}"
        return Diagnostic(span, Code.QOS_CONFLICT, message, f"a topic has one; see {first.topic.span}")
    publisher, subscriber = (use, first) if use.publishes else (first, use)
    if reason := _unheard(publisher.qos, subscriber.qos):
        message = f"{subscriber.owner} hears nothing that {publisher.owner} publishes on"
        return Diagnostic(span, Code.QOS_CONFLICT, f"{message} '{name}': {reason}", "give both the same QoS")
    return None


def _unheard(offered: QosPlan, requested: QosPlan) -> str:
    """Why DDS would not match the two, empty when it does."""
    if offered.reliability == "best_effort" and requested.reliability == "reliable":
        return "it wants reliable and gets best_effort"
    if offered.durability == "volatile" and requested.durability == "transient_local":
        return "it wants transient_local and gets volatile"
    if _is_longer(offered.deadline, requested.deadline):
        return "it wants a shorter deadline than is offered"
    if _is_longer(offered.liveliness_lease_duration, requested.liveliness_lease_duration):
        return "it wants a shorter liveliness lease than is offered"
    if offered.liveliness == "automatic" and requested.liveliness == "manual_by_topic":
        return "it wants liveliness manual_by_topic and gets automatic"
    return ""


def _is_longer(offered: int | None, requested: int | None) -> bool:
    """None is for ever."""
    return requested is not None and (offered is None or offered > requested)

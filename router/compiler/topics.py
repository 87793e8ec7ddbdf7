"""ROS topics: names, QoS, and checks across all routes and gateways that name a topic."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

from router.compiler.compiled_table import QosPlan
from router.compiler.expressions import Scope
from router.compiler.expressions.scope import field_of
from router.compiler.expressions.tree import Node
from router.errors import Code, Diagnostic, Located, SourceSpan
from router.table.keys import keys_of
from router.table.model import RouteTable
from router.table.model.endpoints import EndpointKind
from router.table.model.gateways import InboundDeadman
from router.table.model.routes import Route
from router.table.model.settings import NodeSettings
from router.table.model.targets import OnLimit, Qos, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase

DEFAULT_DEPTH = 10
LONGEST_NAME = 247
HEADER = "std_msgs/msg/Header"
DIAGNOSTICS, DIAGNOSTICS_TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
_NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)

PROFILES: Mapping[str, QosPlan] = {
    "default": QosPlan("reliable", "volatile", "keep_last", DEFAULT_DEPTH),
    "sensor_data": QosPlan("best_effort", "volatile", "keep_last", 5),
    "services_default": QosPlan("reliable", "volatile", "keep_last", DEFAULT_DEPTH),
    "parameters": QosPlan("reliable", "volatile", "keep_last", 1000),
    "parameter_events": QosPlan("reliable", "volatile", "keep_last", 1000),
    "action_status_default": QosPlan("reliable", "transient_local", "keep_last", 1),
    "system_default": QosPlan("system_default", "system_default", "system_default", DEFAULT_DEPTH),
    "best_available": QosPlan("best_available", "best_available", "keep_last", DEFAULT_DEPTH),
}
"""The profiles of rmw, by rclpy's names."""


def diagnostics_topic(node: NodeSettings) -> Topic | None:
    """Return the topic /diagnostics, if the table enables it."""
    if node.diagnostics is None:
        return None
    span = node.diagnostics
    return Topic(topic=Located(DIAGNOSTICS, span), span=span, type=Located(DIAGNOSTICS_TYPE, span))


def with_types(table: RouteTable, cases: Mapping[str, PayloadCase], findings: list[Diagnostic]) -> RouteTable:
    """Return the table with a type, or a finding, for each topic of a route whose payload case exists.

    The default is the message of `defaults.package` with the name of the payload's protobuf message.
    """

    def typed(topic: Topic, case: PayloadCase) -> Topic:
        name = case.type.name.rpartition(".")[2]
        if topic.type is not None:
            return topic
        if table.package is not None and topic.for_each is None:
            return replace(topic, type=Located(f"{table.package.value}/msg/{name}", topic.topic.span))
        if "package" in table.broken:
            return topic
        message = f"the topic '{topic.topic.value}' lacks the key 'type'"
        hint = f"add it, or set `defaults: {{package: PACKAGE}}`, which makes it PACKAGE/msg/{name}"
        if topic.for_each is not None:
            hint = "add it: with `for_each`, it has no default"
        findings.append(Diagnostic(topic.topic.span, Code.MISSING_KEY, message, hint))
        return topic

    def route_with_types(route: Route) -> Route:
        case = cases.get(route.case.value)
        if case is None:
            return route
        topics = tuple(typed(topic, case) for topic in route.topics)
        return replace(route, topics=topics, source_topics=tuple(typed(topic, case) for topic in route.source_topics))

    return replace(table, routes=tuple(map(route_with_types, table.routes)))


def topic_name_finding(topic: Topic) -> Diagnostic | None:
    """Return a finding if the name of a topic is invalid."""
    name = topic.topic.value
    if not _NAME.fullmatch(name):
        hint = "use letters, digits and '_', with '/' between parts; no part starts with a digit"
        return Diagnostic(topic.topic.span, Code.BAD_TOPIC_NAME, f"'{name}' is not a ROS topic name", hint)
    if len(name) > LONGEST_NAME:
        message = f"a ROS topic name has at most {LONGEST_NAME} characters, this one has {len(name)}"
        return Diagnostic(topic.topic.span, Code.BAD_TOPIC_NAME, message)
    return None


def stamp_of(scope: Scope, span: SourceSpan) -> Node | None:
    """Return the field `header.stamp`, or None."""
    header = scope.message.field("header")
    if header is None or not isinstance(header.type, MessageType) or header.type.name != HEADER:
        return None
    stamp = header.type.field("stamp")
    return field_of(field_of(scope.whole_message(span), header, span), stamp, span) if stamp else None


def resolved(name: str, node: NodeSettings) -> str:
    """Return the absolute ROS name of a topic of this node."""
    namespace = node.namespace.rstrip("/")
    if name.startswith("~/"):
        return f"{namespace}/{node.name}/{name[2:]}"
    return name if name.startswith("/") else f"{namespace}/{name}"


def qos_of(topic: Topic) -> QosPlan:
    """Return the complete QoS: the profile, the table's other settings, and `queue_depth` as the depth."""
    given = topic.qos
    plan = PROFILES[given.profile.value if given and given.profile else "default"]
    words = [key.name for key in keys_of(Qos) if key.name != "profile"]
    said = {word: setting.value for word in words if (setting := getattr(given, word, None)) is not None}
    if topic.queue_depth is not None:
        said["depth"] = topic.queue_depth.value
    return replace(plan, **said)


def qos_findings(topic: Topic, *, publishes: bool) -> Iterator[Diagnostic]:
    """Yield findings for contradictions in one topic's QoS, and for a QoS that lets a subscriber block the router."""
    given = topic.qos
    if given is None:
        return
    plan = qos_of(topic)

    def conflict(span: SourceSpan, message: str, hint: str) -> Diagnostic:
        return Diagnostic(span, Code.QOS_CONFLICT, message, hint)

    if given.depth and topic.queue_depth and given.depth.value != topic.queue_depth.value:
        message = f"depth {given.depth.value} contradicts queue_depth {topic.queue_depth.value}"
        yield conflict(given.depth.span, message, "set only one of them")
    if given.history and given.history.value == "keep_all":
        if depth := given.depth or topic.queue_depth:
            yield conflict(depth.span, "history keep_all has no depth", "remove the depth, or write keep_last")
        elif publishes and plan.reliability != "best_effort":
            # A full history blocks a reliable publisher in the middleware: measured, 100 ms per message.
            message = "with keep_all, a single stalled subscription would block the router"
            yield conflict(given.history.span, message, "set a depth instead, or reliability: best_effort")
    if plan.durability == "transient_local" and plan.reliability == "best_effort":
        span = given.durability or given.reliability or given.profile
        yield conflict(span.span if span else given.span, "late joiners receive nothing from a best_effort publisher",
                       "set reliability: reliable for transient_local")  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Use:
    """One use of a topic in the table. `owner` names the route or gateway in findings."""

    topic: Topic
    owner: str
    publishes: bool
    qos: QosPlan
    route: Route | None = None
    deadman: InboundDeadman | None = None


def topic_findings(table: RouteTable, routes: Sequence[Route]) -> Iterator[Diagnostic]:
    """Check topics that several routes, states or gateways name.

    A topic must have one type, one QoS per direction, compatible QoS of publisher and subscription, no way back to a
    sender, and no deadman that competes with other publishers. A state counts with its topic, a gateway with those of
    its `inbound`.
    """
    for name, uses in _uses(table, routes).items():
        firsts = [uses[0], *[use for use in uses if use.publishes != uses[0].publishes][:1]]
        for use in uses[1:]:
            findings = (_disagreement(name, first, use) for first in firsts if first is not use)
            if finding := next(filter(None, findings), None):
                yield finding
        for publisher, subscriber in product(uses, uses):
            if publisher.publishes and not subscriber.publishes and publisher.route and subscriber.route:
                yield from _loops(name, publisher.route, subscriber.route)
        for use in uses:
            yield from _deadman_conflicts(name, use, uses)
            yield from _limited_stops(table, use, uses)


def _uses(table: RouteTable, routes: Sequence[Route]) -> Mapping[str, Sequence[_Use]]:
    """Return all uses of topics by absolute name."""
    uses: dict[str, list[_Use]] = {}
    for use in _all_uses(table, routes):
        if topic_name_finding(use.topic) is None:
            uses.setdefault(resolved(use.topic.topic.value, table.node), []).append(use)
    return uses


def _all_uses(table: RouteTable, routes: Sequence[Route]) -> Iterator[_Use]:
    for route in routes:
        for topic in route.all_topics:
            yield _Use(topic, f"route '{route.name}'", topic in route.topics, qos_of(topic), route)
    for state in table.states.values():
        if state.topic is not None:
            yield _Use(state.topic, f"state '{state.name}'", False, qos_of(state.topic))
    for gateway in table.gateways.values():
        for inbound in gateway.inbound:
            owner = f"gateway '{gateway.name}'"
            yield _Use(inbound.topic, owner, True, qos_of(inbound.topic), deadman=inbound.deadman)


def _loops(name: str, publisher: Route, subscriber: Route) -> Iterator[Diagnostic]:
    """Yield findings for endpoints that would get their own messages back through a topic.

    Another payload case is no loop but an answer.
    """
    if publisher.case.value != subscriber.case.value:
        return
    sources = {source.value for source in publisher.sources}
    for destination in subscriber.destinations:
        sender = destination.endpoint
        if sender.value in sources:
            message = f"'{sender.value}' would get its own '{publisher.case.value}' back through the topic '{name}'"
            hint = "remove it from the destinations, or give one of the routes another topic"
            yield Diagnostic(sender.span, Code.FORWARDING_LOOP, message, hint)


def _deadman_conflicts(name: str, use: _Use, others: Sequence[_Use]) -> Iterator[Diagnostic]:
    """Yield a finding if a gateway's deadman publishes where others also publish, or feeds the deadman of a route."""
    if use.deadman is None:
        return
    for other in others:
        if other.publishes and other.owner != use.owner:
            message = f"this deadman would publish on '{name}' while {other.owner} also publishes there"
            hint = "give each its own topic, and let a node such as twist_mux choose between them"
        elif other.route is not None and other.route.deadman is not None and not other.publishes:
            message = f"this deadman's messages on '{name}' would keep the deadman of {other.owner} from tripping"
            hint = "remove this deadman: the route has its own"
        else:
            continue
        yield Diagnostic(use.deadman.span, Code.BAD_VALUE, message, hint)
        return


def _limited_stops(table: RouteTable, use: _Use, others: Sequence[_Use]) -> Iterator[Diagnostic]:
    """Yield a finding if a route's `max_rate` may drop the one message that a client's deadman publishes at its end."""
    if use.deadman is None or use.deadman.because is not None:
        return
    for route in [other.route for other in others if other.route is not None and not other.publishes]:
        for destination in route.destinations:
            endpoint = table.endpoints.get(destination.endpoint.value)
            is_board = endpoint is not None and endpoint.kind is EndpointKind.BOARD
            if is_board and destination.max_rate is not None and destination.on_limit is OnLimit.FIRST:
                message = (
                    f"when the router stops, '{destination.endpoint.value}' may not get this deadman's message: "
                    f"`max_rate` of route '{route.name}' drops what follows a command too soon"
                )
                hint = "add `on_limit: latest` to that destination, or `because: why` here"
                yield Diagnostic(use.deadman.span, Code.DOUBTFUL_DEADMAN, message, hint)
                return


def _disagreement(name: str, first: _Use, use: _Use) -> Diagnostic | None:
    if use.topic.type and first.topic.type and use.topic.type.value != first.topic.type.value:
        message = f"topic '{name}' has the type {first.topic.type.value} in {first.owner}"
        hint = f"use one type for the topic; see {first.topic.type.span}"
        return Diagnostic(use.topic.type.span, Code.TOPIC_TYPE_CLASH, message, hint)
    span = use.topic.qos.span if use.topic.qos else (use.topic.queue_depth or use.topic.topic).span
    if use.publishes == first.publishes:
        if use.qos == first.qos:
            return None
        message = f"topic '{name}' has a different QoS in {first.owner}"
        return Diagnostic(span, Code.QOS_CONFLICT, message, f"use one QoS for the topic; see {first.topic.span}")
    publisher, subscriber = (use, first) if use.publishes else (first, use)
    if reason := _qos_mismatch(publisher.qos, subscriber.qos):
        message = f"{subscriber.owner} would not receive what {publisher.owner} publishes on"
        return Diagnostic(span, Code.QOS_CONFLICT, f"{message} '{name}': {reason}", "give both the same QoS")
    return None


def _qos_mismatch(offered: QosPlan, requested: QosPlan) -> str:
    """Return why DDS would not match the two, or an empty string."""
    if offered.reliability == "best_effort" and requested.reliability == "reliable":
        return "it requests reliable, but best_effort is offered"
    if offered.durability == "volatile" and requested.durability == "transient_local":
        return "it requests transient_local, but volatile is offered"
    if _is_longer(offered.deadline, requested.deadline):
        return "it requests a shorter deadline than is offered"
    if _is_longer(offered.liveliness_lease_duration, requested.liveliness_lease_duration):
        return "it requests a shorter liveliness lease than is offered"
    if offered.liveliness == "automatic" and requested.liveliness == "manual_by_topic":
        return "it requests liveliness manual_by_topic, but automatic is offered"
    return ""


def _is_longer(offered: int | None, requested: int | None) -> bool:
    """Return whether a duration is longer than another; None is infinite."""
    return requested is not None and (offered is None or offered > requested)

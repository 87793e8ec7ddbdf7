"""Checks routes from UDP: what is forwarded as it came, what fills topics, and how frames are put together."""

from __future__ import annotations

from router.compiler.checked import CheckedCollect, CheckedRoute, CheckedTarget
from router.compiler.destinations import destinations, keep, max_rate, target_to
from router.compiler.expressions import ParsedReads, Typed
from router.compiler.kinds import UINT32, BoolKind, EnumKind, IntKind, ListKind, MessageKind, StringKind
from router.compiler.lookup import Lookup
from router.compiler.mapping import build
from router.compiler.syntax import load
from router.compiler.target import Target
from router.errors import Code, SourceSpan
from router.table.model import Collect, Destination, Endpoint, Route, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase


def check_inbound(lookup: Lookup, route: Route, case: PayloadCase) -> CheckedRoute:
    if route.fields is not None:
        message = "'fields' of a route belongs to `source: ros`"
        lookup.report(route.fields.span, Code.UNKNOWN_KEY, message, "a topic has its own 'fields'")
    targets = [_forward(lookup, route, case, to, endpoint) for to, endpoint in destinations(lookup, route, case)]
    names = _frame_names(case, route.collect.span) if route.collect else {}
    for topic in route.topics:
        ros_type = lookup.ros_type(topic)
        if ros_type is not None:
            targets.append(_publish(lookup, case, topic, ros_type, names))
    collect = _collect(lookup, route, case, route.collect) if route.collect else None
    return CheckedRoute(route, case, tuple(targets), collect=collect)


def _forward(
    lookup: Lookup, route: Route, case: PayloadCase, destination: Destination, endpoint: Endpoint | None
) -> CheckedTarget:
    if destination.fields is not None:
        hint = "'fields' of a destination belongs to `source: ros`"
        lookup.report(destination.fields.span, Code.UNKNOWN_KEY, "a datagram is forwarded unchanged", hint)
    reads = ParsedReads()
    when = lookup.when(destination.when, lookup.scope(case.type, reads))
    return CheckedTarget(target_to(lookup, route, destination, endpoint, when, reads))


def _publish(
    lookup: Lookup, case: PayloadCase, topic: Topic, ros_type: MessageType, names: dict[str, Typed]
) -> CheckedTarget:
    reads = ParsedReads()
    scope = lookup.scope(case.type, reads, ros_type, names)
    when = lookup.when(topic.when, scope)
    mapping = build(topic.fields, ros_type, scope, topic.topic.span)
    lookup.findings += mapping.findings
    name, rate = topic.topic.value, max_rate(topic)
    target = Target(name, topic.span, True, reads, when, rate, keep(topic), plan=mapping.plan)
    return CheckedTarget(target, topic, ros_type, tuple(mapping.rows))


def _frame_names(case: PayloadCase, span: SourceSpan) -> dict[str, Typed]:
    """What the topics of a route that collects see beside the fields of the frame's first part."""
    items = Typed.at(span, ListKind(MessageKind(case.type)), load("items"))
    return {"items": items, "count": Typed.at(span, UINT32, load("count"))}


def _collect(lookup: Lookup, route: Route, case: PayloadCase, collect: Collect) -> CheckedCollect | None:
    if not route.topics and route.destinations:
        message = "'collect' puts frames together for topics, and there are none"
        lookup.report(collect.span, Code.UNKNOWN_KEY, message, "destinations get each datagram as it came")
    reads = ParsedReads()
    scope = lookup.scope(case.type, reads)
    names = (IntKind, EnumKind, StringKind, BoolKind)
    by = lookup.value(collect.by, scope, names, "'by' takes what can name a frame: an integer or a string")
    count = lookup.value(collect.count, scope, (IntKind,), "'count' takes an integer")
    order = lookup.value(collect.order, scope, (IntKind,), "'order' takes an integer")
    if by is None or count is None or order is None:
        return None
    return CheckedCollect(collect.span, reads, by, count, order)

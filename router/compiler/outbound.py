"""Checks routes from ROS: the topics that feed them, and the payload that each destination gets of them."""

from __future__ import annotations

from collections.abc import Sequence

from router.compiler.cdr.reading import CdrReads
from router.compiler.checked import CheckedFeed, CheckedRoute, CheckedTarget
from router.compiler.destinations import destinations, target_to
from router.compiler.expressions import Scope, Typed
from router.compiler.kinds import UINT32, ListKind
from router.compiler.lookup import Lookup
from router.compiler.mapping import build
from router.compiler.syntax import load
from router.errors import Code, SourceSpan
from router.table.model import Destination, Endpoint, Expression, Route, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase

Destinations = Sequence[tuple[Destination, "Endpoint | None"]]
HEADER = "std_msgs/msg/Header"


def check_outbound(lookup: Lookup, route: Route, case: PayloadCase) -> CheckedRoute:
    name = route.name
    if not route.topics:
        message = f"'{name}' comes from ROS, but from no topic"
        lookup.report(route.span, Code.NO_TARGET, message, "name it under 'topics'")
    if route.topics and not route.destinations:
        message = f"'{name}' goes to no destination"
        lookup.report(route.span, Code.NO_TARGET, message, "name it under 'destinations'")
    found = destinations(lookup, route, case)
    feeds = []
    for topic in route.topics:
        _subscribed(lookup, route, topic)
        ros_type = lookup.ros_type(topic)
        if ros_type is not None and (feed := _feed(lookup, route, case, topic, ros_type, found)):
            feeds.append(feed)
    return CheckedRoute(route, case, feeds=tuple(feeds))


def _subscribed(lookup: Lookup, route: Route, topic: Topic) -> None:
    """What a topic may say where it is published only, or once."""
    if topic.fields is not None:
        message = "with `source: ros` the fields to fill are the payload's"
        lookup.report(topic.fields.span, Code.UNKNOWN_KEY, message, "move 'fields' up to the route")
    if topic.max_rate is not None:
        message = "with `source: ros` it is destinations that take a 'max_rate'"
        lookup.report(topic.max_rate.span, Code.UNKNOWN_KEY, message, "move it to {endpoint: NAME, max_rate: ...}")
    name = topic.topic.value
    if next(other for other in route.topics if other.topic.value == name) is not topic:
        lookup.report(topic.topic.span, Code.BAD_VALUE, f"'{name}' is a topic twice", "name it once")


def _feed(
    lookup: Lookup, route: Route, case: PayloadCase, topic: Topic, ros_type: MessageType, found: Destinations
) -> CheckedFeed | None:
    """None where it is not known what `item` is: all that names it would only seem wrong."""
    reads = CdrReads(ros_type)
    scope = lookup.scope(ros_type, reads, ros_type)
    stamp = _stamp(scope, topic.span) if route.ttl else None
    for_each = None
    if route.for_each is not None:
        for_each = _elements(lookup, route.for_each, scope)
        if for_each is None:
            return None
        scope = lookup.scope(ros_type, reads, ros_type, _element_names(for_each))
    when = lookup.when(topic.when, scope)
    own = any(destination.fields for destination, _ in found)  # then the route need not have any
    targets = []
    for destination, endpoint in found:
        condition = lookup.when(destination.when, scope)
        fields = destination.fields or route.fields or topic.fields  # the last are misplaced, but meant
        whole = scope.variable("item", route.span) if for_each else None
        mapping = build(fields, case.type, scope, destination.span if own else route.span, whole)
        lookup.findings += mapping.findings
        target = target_to(lookup, route, destination, endpoint, condition, plan=mapping.plan)
        targets.append(CheckedTarget(target, rows=tuple(mapping.rows)))
    return CheckedFeed(topic, ros_type, reads, when, for_each, stamp, tuple(targets))


def _stamp(scope: Scope, span: SourceSpan) -> Typed | None:
    """`header.stamp` of a message that has one."""
    header = scope.message.field("header")
    if header is None or not isinstance(header.type, MessageType) or header.type.name != HEADER:
        return None
    stamp = header.type.field("stamp")
    return scope.read(("header",), stamp, span) if stamp else None


def _elements(lookup: Lookup, expression: Expression, scope: Scope) -> Typed | None:
    """The list of `for_each`. An empty literal is no list that anything could be of."""
    typed = lookup.value(expression, scope, (ListKind,), "'for_each' takes a list")
    if typed is not None and isinstance(typed.kind, ListKind) and typed.kind.element is None:
        lookup.report(typed.span, Code.TYPE_MISMATCH, "'for_each' takes a list with elements, not an empty one")
        return None
    return typed


def _element_names(elements: Typed) -> dict[str, Typed]:
    """What expressions see beside the fields of the message that has the list."""
    assert isinstance(elements.kind, ListKind)  # noqa: S101 - see _elements
    assert elements.kind.element is not None  # noqa: S101
    return {
        "item": Typed.at(elements.span, elements.kind.element, load("item")),
        "index": Typed.at(elements.span, UINT32, load("index")),
        "count": Typed.at(elements.span, UINT32, load("count")),
    }

"""Where a route goes and what it listens to: nodes that have their shape to Destination, Topic and Qos.

Knows the schema's shape; which endpoints and ROS types exist is the compiler's business.
"""

from __future__ import annotations

from router.errors import SourceSpan
from router.table.build_fields import fields, optional_expression
from router.table.model import Destination, Keep, Located, Qos, Topic
from router.table.nodes import Entry, MappingNode, Node, ScalarNode
from router.table.reading import UnsoundError, duration, integer, located, mapping, number_or_text, optional_text, text
from router.table.units import parse_rate


def destination(node: Node) -> Destination:
    if isinstance(node, ScalarNode):
        return Destination(located(node), node.span)
    settings = mapping(node)
    return Destination(
        endpoint=text(settings, "endpoint"),
        span=item_span(settings),
        when=optional_expression(settings, "when"),
        max_rate=_max_rate(settings),
        keep=_keep(settings),
        fields=fields(settings),
    )


def topic(node: Node) -> Topic:
    settings = mapping(node)
    return Topic(
        topic=text(settings, "topic"),
        type=text(settings, "type"),
        span=item_span(settings),
        queue_depth=integer(settings, "queue_depth"),
        qos=_qos(settings.entries.get("qos")),
        when=optional_expression(settings, "when"),
        max_rate=_max_rate(settings),
        keep=_keep(settings),
        fields=fields(settings),
    )


def item_span(settings: MappingNode) -> SourceSpan:
    """A mapping in a list has no key of its own; its first key stands for it."""
    return next(iter(settings.entries.values())).key.span


def _qos(entry: Entry | None) -> Qos | None:
    if entry is None:
        return None
    settings = mapping(entry.value)
    return Qos(
        span=entry.key.span,
        profile=optional_text(settings, "profile"),
        reliability=optional_text(settings, "reliability"),
        durability=optional_text(settings, "durability"),
        history=optional_text(settings, "history"),
        depth=integer(settings, "depth"),
        deadline=duration(settings, "deadline"),
        lifespan=duration(settings, "lifespan"),
        liveliness=optional_text(settings, "liveliness"),
        liveliness_lease_duration=duration(settings, "liveliness_lease_duration"),
    )


def _max_rate(settings: MappingNode) -> Located[float] | None:
    node = settings.get("max_rate")
    if node is None:
        return None
    written = number_or_text(node)
    return Located(UnsoundError.guard(parse_rate, written), written.span)


def _keep(settings: MappingNode) -> Located[Keep] | None:
    written = optional_text(settings, "keep")
    return Located(Keep(written.value), written.span) if written else None

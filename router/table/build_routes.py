"""Routes: nodes that have their shape to Route, Destination, Topic, Qos, FieldMap and Expression.

Knows the schema's shape; which names exist is the compiler's business.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from router.errors import SourceSpan
from router.table.model import Destination, Expression, FieldEntry, FieldMap, Located, Qos, Route, Topic
from router.table.nodes import Entry, MappingNode, Node, ScalarNode, SequenceNode, is_sound
from router.table.places import TextPlace
from router.table.reading import UnsoundError, boolean, integer, items, located, mapping, optional_text, scalar, text
from router.table.units import parse_duration, parse_rate

AUTO = "auto"

_INDISPENSABLE = frozenset({"source", "ignore", "topic", "type", "endpoint"})
"""Keys without which a route, a topic or a destination says nothing."""

_SUFFICIENT = ({"source"}, {"ignore"}, {"topic", "type"}, {"endpoint"})
"""Keys with which it says something, whatever else it lacks or has too much."""


def sound_part(entry: Entry) -> Entry | None:
    """A route without what has findings of its own, so that the rest is checked in the same run."""
    value = None if entry.key.broken else _sound_part(entry.value)
    return Entry(entry.key, value) if value else None


def _sound_entry(entry: Entry) -> Entry | None:
    """What stands under a key of a route: broken as a whole it may be a mapping where a list belongs."""
    return None if entry.value.broken else sound_part(entry)


def _sound_part(node: Node) -> Node | None:
    if isinstance(node, MappingNode):
        if node.broken and not any(keys <= node.entries.keys() for keys in _SUFFICIENT):
            return None
        if any(key in _INDISPENSABLE and not is_sound(entry.value) for key, entry in node.entries.items()):
            return None
        parts = {key: entry if is_sound(entry.value) else _sound_entry(entry) for key, entry in node.entries.items()}
        return replace(node, entries={key: part for key, part in parts.items() if part})
    if node.broken:
        return None
    if isinstance(node, SequenceNode) and all(isinstance(item, MappingNode) for item in node.items):
        return replace(node, items=tuple(part for item in node.items if (part := _sound_part(item))))
    return node if is_sound(node) else None


def build_route(entry: Entry) -> Route:
    settings = mapping(entry.value)
    source = settings.get("source")
    names = source.items if isinstance(source, SequenceNode) else (source,) if source else ()
    return Route(
        name=entry.key.text,
        case=Located(entry.key.text, entry.key.span),
        sources=tuple(map(located, names)),
        destinations=tuple(map(_destination, items(settings, "destinations"))),
        topics=tuple(map(_topic, items(settings, "topics"))),
        fields=_fields(settings),
        ignore=optional_text(settings, "ignore"),
    )


def _destination(node: Node) -> Destination:
    if isinstance(node, ScalarNode):
        return Destination(located(node), node.span)
    settings = mapping(node)
    return Destination(
        endpoint=text(settings, "endpoint"),
        span=_item_span(settings),
        when=_when(settings),
        max_rate=_max_rate(settings),
        fields=_fields(settings),
    )


def _topic(node: Node) -> Topic:
    settings = mapping(node)
    return Topic(
        topic=text(settings, "topic"),
        type=text(settings, "type"),
        span=_item_span(settings),
        queue_depth=integer(settings, "queue_depth"),
        qos=_qos(settings.entries.get("qos")),
        when=_when(settings),
        max_rate=_max_rate(settings),
        fields=_fields(settings),
    )


def _item_span(settings: MappingNode) -> SourceSpan:
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
        deadline=_duration(settings, "deadline"),
        lifespan=_duration(settings, "lifespan"),
        liveliness=optional_text(settings, "liveliness"),
        liveliness_lease_duration=_duration(settings, "liveliness_lease_duration"),
    )


def _duration(settings: MappingNode, key: str) -> Located[int] | None:
    written = optional_text(settings, key)
    return Located(UnsoundError.guard(parse_duration, written), written.span) if written else None


def _max_rate(settings: MappingNode) -> Located[float] | None:
    node = settings.get("max_rate")
    if node is None:
        return None
    found = scalar(node)
    if found.value is None or isinstance(found.value, bool):
        raise TypeError(f"a rate, not {found.value!r}")
    written: Located[str | float] = Located(found.value, found.span)
    return Located(UnsoundError.guard(parse_rate, written), found.span)


def _when(settings: MappingNode) -> Expression | None:
    node = settings.get("when")
    return _expression(node) if node else None


def _fields(settings: MappingNode) -> FieldMap | None:
    entry = settings.entries.get("fields")
    if entry is None:
        return None
    if isinstance(entry.value, ScalarNode):
        return FieldMap(entry.value.span, auto=True, entries=())
    written = mapping(entry.value)
    own = MappingNode(written.span, {key: member for key, member in written.entries.items() if key != AUTO})
    return FieldMap(entry.key.span, auto=boolean(written, AUTO), entries=tuple(_entries(own, (), ())))


def _entries(fields: MappingNode, path: tuple[str, ...], spans: tuple[SourceSpan, ...]) -> Iterator[FieldEntry]:
    for name, entry in fields.entries.items():
        inner = (*path, *name.split("."))
        inner_spans = (*spans, *_part_spans(entry.key))
        if isinstance(entry.value, MappingNode):
            yield from _entries(entry.value, inner, inner_spans)
        else:
            yield FieldEntry(inner, inner_spans, _expression(entry.value))


def _part_spans(key: ScalarNode) -> Iterator[SourceSpan]:
    """The places of the names between the dots of a key; the whole key where its text is not verbatim."""
    start = 0
    for part in key.text.split("."):
        yield key.place.part(start, start + len(part))
        start += len(part) + 1


def _expression(node: Node) -> Expression:
    if isinstance(node, SequenceNode):
        return Expression("", TextPlace(node.span), tuple(map(_expression, node.items)))
    found = scalar(node)
    return Expression(found.text, found.place)

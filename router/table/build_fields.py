"""Field mappings and expressions: nodes that have their shape to FieldMap and Expression.

Knows the schema's shape; which fields exist, and what an expression means, is the compiler's business.
"""

from __future__ import annotations

from collections.abc import Iterator

from router.errors import SourceSpan
from router.table.model import Expression, FieldEntry, FieldMap
from router.table.nodes import Entry, MappingNode, Node, ScalarNode, SequenceNode
from router.table.places import TextPlace
from router.table.reading import boolean, mapping, scalar

AUTO = "auto"


def optional_expression(settings: MappingNode, key: str) -> Expression | None:
    node = settings.get(key)
    return expression(node) if node else None


def expression(node: Node | None) -> Expression:
    """A scalar as it was written, or a list of expressions."""
    if isinstance(node, SequenceNode):
        return Expression("", TextPlace(node.span), tuple(map(expression, node.items)))
    found = scalar(node)
    return Expression(found.text, found.place)


def fields(settings: MappingNode) -> FieldMap | None:
    """What `fields` says, None where there is no such key."""
    entry = settings.entries.get("fields")
    if entry is None:
        return None
    if isinstance(entry.value, ScalarNode):
        return FieldMap(entry.value.span, auto=True, entries=())
    written = mapping(entry.value)
    own = MappingNode(written.span, {key: member for key, member in written.entries.items() if key != AUTO})
    return FieldMap(entry.key.span, auto=boolean(written, AUTO), entries=tuple(_entries(own, (), ())))


def constants(entry: Entry) -> FieldMap:
    """The fields of a payload that is not filled from a message; here `auto` is a field like any other."""
    return FieldMap(entry.key.span, auto=False, entries=tuple(_entries(mapping(entry.value), (), ())))


def _entries(fields: MappingNode, path: tuple[str, ...], spans: tuple[SourceSpan, ...]) -> Iterator[FieldEntry]:
    for name, entry in fields.entries.items():
        inner = (*path, *name.split("."))
        inner_spans = (*spans, *_part_spans(entry.key))
        if isinstance(entry.value, MappingNode):
            yield from _entries(entry.value, inner, inner_spans)
        else:
            yield FieldEntry(inner, inner_spans, expression(entry.value))


def _part_spans(key: ScalarNode) -> Iterator[SourceSpan]:
    """The places of the names between the dots of a key; the whole key where its text is not verbatim."""
    start = 0
    for part in key.text.split("."):
        yield key.place.part(start, start + len(part))
        start += len(part) + 1

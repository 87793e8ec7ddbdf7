"""What can still be checked of a route or a gateway that has findings, so that one run shows all of them.

Knows which keys make the rest of it meaningless by their absence, nothing else of what they mean.
"""

from __future__ import annotations

from dataclasses import replace

from router.table.nodes import Entry, MappingNode, Node, SequenceNode, is_sound

_INDISPENSABLE = frozenset(
    {"source", "ignore", "topic", "type", "endpoint", "timeout", "send", "to", "by", "count", "order", "transport"}
)
"""Keys without which a route, a topic, a destination, a deadman, a collect or a gateway says nothing."""

_SUFFICIENT = ({"source"}, {"ignore"}, {"topic", "type"}, {"endpoint"}, {"transport"})
"""Keys with which it says something, whatever else it lacks or has too much."""

_USES_NAMES_OF = {"for_each": ("fields", "destinations", "topics"), "collect": ("topics",)}
"""Where a route's expressions use names (`item`, `items`) that there are only with this key."""


def sound_part(entry: Entry) -> Entry | None:
    """A case or a gateway without what has findings of its own, so that the rest is checked in the same run."""
    value = None if entry.key.broken else _sound_part(entry.value)
    return Entry(entry.key, value) if value else None


def _sound_part(node: Node) -> Node | None:
    if isinstance(node, MappingNode):
        return _sound_mapping(node)
    if node.broken:
        return None
    if isinstance(node, SequenceNode) and any(map(_says_something, node.items)):
        return replace(node, items=tuple(part for item in node.items if (part := _sound_part(item))))
    return node if is_sound(node) else None


def _sound_mapping(node: MappingNode) -> MappingNode | None:
    if node.broken and not _says_something(node):
        return None
    unsound = {key for key, entry in node.entries.items() if not is_sound(entry.value)}
    if unsound & _INDISPENSABLE:
        return None
    left_out = {user for key, users in _USES_NAMES_OF.items() if key in unsound for user in users}
    parts = {
        key: _sound_entry(entry) if key in unsound else entry
        for key, entry in node.entries.items()
        if key not in left_out
    }
    return replace(node, entries={key: part for key, part in parts.items() if part})


def _sound_entry(entry: Entry) -> Entry | None:
    """What stands under a key of a route: broken as a whole it may be a mapping where a list belongs."""
    return None if entry.value.broken else sound_part(entry)


def _says_something(node: Node) -> bool:
    return isinstance(node, MappingNode) and any(keys <= node.entries.keys() for keys in _SUFFICIENT)

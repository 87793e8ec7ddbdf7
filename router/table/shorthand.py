"""Expansion of a table's short forms, so that the rest of the router handles only one form.

| short | written out |
|---|---|
| `topic: imu_data` in a route | `topics: [{topic: imu_data}]` |
| a topic by name, `topics: [imu_data]` | `topics: [{topic: imu_data}]` |
| `reply: {pong: {id: id}}` in a route | `reply: {case: pong, fields: {id: id}}` |
| `qos: sensor_data` | `qos: {profile: sensor_data}` |
| a key of `defaults` | that key wherever it applies and is missing |

Expanded nodes keep the positions of the short form, defaults those in `defaults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

from router.errors import SourceSpan
from router.table.nodes import Entry, MappingNode, Node, ScalarNode, SequenceNode, TextSpan, is_valid

Entries = Mapping[str, Entry]
NodeT = TypeVar("NodeT", bound=Node)


def written_out(root: MappingNode) -> MappingNode:
    """Return the table without short forms. Nodes that do not fit the schema are marked broken in it."""
    group = root.get("defaults")
    defaults = _valid_entries(group) if isinstance(group, MappingNode) else {}
    in_long = _Shorthand(defaults, _of_deadmen(group))
    root = _changed(root, "routes", lambda routes: _each_value(routes, lambda case: _one_or_each(case, in_long.route)))
    return _changed(root, "gateways", lambda gateways: _each_value(gateways, in_long.gateway))


class _Shorthand:
    """Writes out parts of a table with these defaults."""

    def __init__(self, defaults: Entries, of_deadmen: Entries) -> None:
        self._of_routes = {key: entry for key, entry in defaults.items() if key == "ttl"}
        self._queue_depth = {key: entry for key, entry in defaults.items() if key == "queue_depth"}
        self._qos = {key: replace(entry, value=_qos(entry.value)) for key, entry in defaults.items() if key == "qos"}
        self._of_deadmen = of_deadmen

    def route(self, node: Node) -> Node:
        if not isinstance(node, MappingNode) or "ignore" in node.entries:
            return node
        topic = node.entries.get("topic")
        if topic is not None:
            others = {key: entry for key, entry in node.entries.items() if key != "topic"}
            node = replace(node, entries={**others, "topics": topic})
        node = _changed(node, "topics", lambda topics: _one_or_each(topics, lambda topic: self._topic(_named(topic))))
        node = _changed(node, "source", lambda source: _one_or_each(source, self._topic))
        node = _changed(node, "reply", _reply)
        return _with(_changed(node, "deadman", self._deadman), self._of_routes)

    def gateway(self, node: Node) -> Node:
        return _changed(node, "inbound", lambda inbound: _one_or_each(inbound, self._inbound))

    def _inbound(self, node: Node) -> Node:
        if isinstance(node, MappingNode) and "service" in node.entries:
            return node
        return _changed(self._topic(node), "deadman", self._deadman)

    def _topic(self, node: Node) -> Node:
        """Expand a mapping with 'topic'. Its own 'qos' or 'queue_depth' overrides the default depth."""
        if not isinstance(node, MappingNode):
            return node
        if "qos" in node.entries:
            return _changed(node, "qos", _qos)
        if "queue_depth" not in node.entries:
            return _with(node, {**self._queue_depth, **self._qos})
        return _with(node, {key: replace(entry, value=_without_depth(entry.value)) for key, entry in self._qos.items()})

    def _deadman(self, node: Node) -> Node:
        return node if isinstance(node, MappingNode) and "none" in node.entries else _with(node, self._of_deadmen)


def _of_deadmen(defaults: Node | None) -> Entries:
    """Return the defaults of deadmen, valid or not. If a mistake may hide the timeout, add one marked broken."""
    deadman = defaults.get("deadman") if isinstance(defaults, MappingNode) else None
    entries = deadman.entries if isinstance(deadman, MappingNode) else {}
    lost = next((node for node in (deadman, defaults) if node and node.broken), None)
    if lost is None or "timeout" in entries:
        return entries
    timeout = replace(_key("timeout", lost.span), broken=True)
    return {**entries, "timeout": Entry(timeout, timeout)}


def _named(node: Node) -> Node:
    """Return a topic as a mapping, also if it is only a name."""
    return _alone("topic", node) if isinstance(node, ScalarNode) else node


def _reply(node: Node) -> Node:
    """Return a reply with the keys `case` and `fields`, also if it is only a payload case with fields."""
    if not isinstance(node, MappingNode) or "case" in node.entries or len(node.entries) != 1:
        return node
    [(name, fields)] = [(entry.key, entry.value) for entry in node.entries.values()]
    entries = {"case": Entry(_key("case", name.span), name), "fields": Entry(_key("fields", name.span), fields)}
    return replace(node, entries=entries)


def _qos(node: Node) -> Node:
    return _alone("profile", node) if isinstance(node, ScalarNode) else node


def _without_depth(qos: Node) -> Node:
    if not isinstance(qos, MappingNode):
        return qos
    return replace(qos, entries={key: entry for key, entry in qos.entries.items() if key != "depth"})


def _alone(key: str, node: ScalarNode) -> MappingNode:
    return MappingNode(node.span, {key: Entry(_key(key, node.span), node)}, node.broken)


def _key(text: str, span: SourceSpan) -> ScalarNode:
    return ScalarNode(span, text, text, TextSpan(span))


def _with(node: Node, defaults: Entries) -> Node:
    """Return the node, if it is a mapping, with those entries of `defaults` that it lacks."""
    if not isinstance(node, MappingNode) or not defaults:
        return node
    missing = {key: entry for key, entry in defaults.items() if key not in node.entries}
    return replace(node, entries={**node.entries, **missing})  # its own entries first: the first is its position


def _changed(node: NodeT, key: str, change: Callable[[Node], Node]) -> NodeT:
    """Return the node, if it is a mapping, with the value of one key changed."""
    if not isinstance(node, MappingNode) or key not in node.entries:
        return node
    entry = node.entries[key]
    return replace(node, entries={**node.entries, key: replace(entry, value=change(entry.value))})


def _each_value(node: Node, change: Callable[[Node], Node]) -> Node:
    if not isinstance(node, MappingNode):
        return node
    entries = {key: replace(entry, value=change(entry.value)) for key, entry in node.entries.items()}
    return replace(node, entries=entries)


def _one_or_each(node: Node, change: Callable[[Node], Node]) -> Node:
    return replace(node, items=tuple(map(change, node.items))) if isinstance(node, SequenceNode) else change(node)


def _valid_entries(node: MappingNode) -> Entries:
    return {key: entry for key, entry in node.entries.items() if is_valid(entry.key) and is_valid(entry.value)}

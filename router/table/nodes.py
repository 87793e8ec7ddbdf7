"""A YAML document as data with positions: scalars, mappings and sequences, each with its span.

`broken` marks nodes that already have a finding, so that they are not reported again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Union

from router.errors import SourceSpan


@dataclass(frozen=True, slots=True)
class TextSpan:
    """The position of each character of a text.

    `stretches` are the parts of the text that a line of the file contains verbatim, each with its offset in the text.
    There are none if the text was computed (escapes, a variable); findings then point at `whole`.
    """

    whole: SourceSpan
    stretches: tuple[tuple[int, SourceSpan], ...] = ()

    def part(self, start: int, end: int) -> SourceSpan:
        """Return the span of characters `start` to `end` of the text (from 0, `end` exclusive), within one line."""
        for offset, span in reversed(self.stretches):
            if offset <= start:
                return span.part(start - offset, min(end - offset, span.end_column - span.column))
        return self.whole

    @property
    def is_whole_line(self) -> bool:
        """Whether the file contains the text verbatim, on one line and without quotes."""
        return [span for _, span in self.stretches] == [self.whole]


def locate(text: str, whole: SourceSpan, pieces: Iterable[tuple[int, int, str]]) -> TextSpan:
    """Return the span of a text that was written in `pieces`, one per line: line and column from 1, and the text.

    Whitespace at the ends of a piece, and the text in place of a line end, is ignored.
    """
    stretches: list[tuple[int, SourceSpan]] = []
    offset = _after_blanks(text, 0)
    for line, column, piece in pieces:
        words = piece.strip()
        if not text.startswith(words, offset):
            return TextSpan(whole)
        if words:
            start = column + piece.index(words)
            stretches.append((offset, SourceSpan(whole.file, line, start, start + len(words))))
        offset = _after_blanks(text, offset + len(words))
    return TextSpan(whole, tuple(stretches) if offset == len(text) else ())


def _after_blanks(text: str, offset: int) -> int:
    while offset < len(text) and text[offset].isspace():
        offset += 1
    return offset


Path = tuple[Union[str, int], ...]
"""Keys and indexes that lead from a document's root to a node."""

Plain = Union[None, bool, int, float, str]


@dataclass(frozen=True, slots=True)
class ScalarNode:
    """A scalar: `text` as written, with variables replaced, `value` in YAML, and the `text_span`.

    If the text `is_filled`, at least one variable was replaced.
    """

    span: SourceSpan
    text: str
    value: Plain
    text_span: TextSpan
    broken: bool = False
    is_filled: bool = False


@dataclass(frozen=True, slots=True)
class SequenceNode:
    span: SourceSpan
    items: tuple[Node, ...]
    broken: bool = False


@dataclass(frozen=True, slots=True)
class Entry:
    key: ScalarNode
    value: Node


@dataclass(frozen=True, slots=True)
class MappingNode:
    """A mapping, with its entries by the text of their key, in the order of the file."""

    span: SourceSpan
    entries: Mapping[str, Entry]
    broken: bool = False

    def get(self, key: str) -> Node | None:
        entry = self.entries.get(key)
        return entry.value if entry else None


Node = Union[ScalarNode, SequenceNode, MappingNode]


def cut_off(pairs: Iterable[tuple[str, Node]]) -> Iterator[str]:
    """Yield keys that are the rest of an expression: `b)` of `{x: max(a, b)}`, where the comma ends the value."""
    opened = 0
    rests: list[str] = []
    for key, value in pairs:
        if not isinstance(value, ScalarNode) or value.text:
            text = value.text if isinstance(value, ScalarNode) else ""
            opened, rests = text.count("(") - text.count(")"), []
        elif opened > 0:
            opened += key.count("(") - key.count(")")
            rests.append(key)
            if opened == 0:
                yield from rests


def to_data(node: Node) -> object:
    """Convert a tree to dictionaries, lists and plain values."""
    if isinstance(node, MappingNode):
        return {key: to_data(entry.value) for key, entry in node.entries.items()}
    if isinstance(node, SequenceNode):
        return [to_data(item) for item in node.items]
    return node.value


def is_valid(node: Node) -> bool:
    """Return whether nothing in the tree is broken."""
    if node.broken:
        return False
    if isinstance(node, MappingNode):
        return all(is_valid(entry.key) and is_valid(entry.value) for entry in node.entries.values())
    return not isinstance(node, SequenceNode) or all(map(is_valid, node.items))


def marked_broken(node: Node, span: SourceSpan) -> Node:
    """Return a copy of the tree in which the node at `span` is broken."""
    if node.span == span:
        return replace(node, broken=True)
    if isinstance(node, MappingNode):
        marked = {key: replace(entry, value=marked_broken(entry.value, span)) for key, entry in node.entries.items()}
        return replace(node, entries=marked)
    if isinstance(node, SequenceNode):
        return replace(node, items=tuple(marked_broken(item, span) for item in node.items))
    return node


def node_at(root: Node, path: Sequence[str | int]) -> Node:
    """Return the node at a path, which must exist."""
    for step in path:
        root = _child(root, step)
    return root


def key_at(root: Node, path: Sequence[str | int]) -> ScalarNode | None:
    """Return the key of the node at `path`; None for the root and for an item of a sequence."""
    if not path or isinstance(path[-1], int):
        return None
    parent = node_at(root, path[:-1])
    return parent.entries[path[-1]].key if isinstance(parent, MappingNode) else None


def rewritten(node: Node, changes: Mapping[Path, Callable[[Node], Node]], here: Path = ()) -> Node:
    """Return a copy of the tree with each change applied to the node at its path, children first."""
    if isinstance(node, MappingNode):
        entries = {
            key: Entry(entry.key, rewritten(entry.value, changes, (*here, key))) for key, entry in node.entries.items()
        }
        node = replace(node, entries=entries)
    elif isinstance(node, SequenceNode):
        items = tuple(rewritten(item, changes, (*here, index)) for index, item in enumerate(node.items))
        node = replace(node, items=items)
    return changes[here](node) if here in changes else node


def _child(node: Node, step: str | int) -> Node:
    if isinstance(node, MappingNode) and isinstance(step, str):
        return node.entries[step].value
    if isinstance(node, SequenceNode) and isinstance(step, int):
        return node.items[step]
    raise LookupError(f"a {type(node).__name__} has no member {step!r}")


MAP, ELSE, TEXT, EACH, FIELDS = "map", "else", "text", "each", "fields"
"""Keys of values that are written as mappings: `{map: fix_quality, GPS_FIX: 1, else: 0}` and `{text: imu_link}`."""

REASONS = ("ignore", "none", "because")
"""Keys whose value is a reason in words."""

SAY_WHY = "say why in words: `{}: TEXT`"
"""The hint for a value of such a key that is no reason."""

_INDISPENSABLE = frozenset({
    "source", "ignore", "none", "for_each", "topic", "type", "endpoint", "timeout", "send", "to", "by", "count",
    "order", "transport",
})  # fmt: skip
"""Keys without which a route, topic, destination, deadman, `collect` or gateway is meaningless."""

_WHOLE = ("obeyed", "reply")
"""Keys whose mapping is meaningless if any part of it is invalid."""

_SUFFICIENT = ({"source"}, {"ignore"}, {"topic"}, {"endpoint"}, {"transport"})
"""Sets of keys, any of which makes a mapping worth checking even if other keys are missing."""

_NEEDED_BY = {"collect": ("topics",), "destinations": ("deadman",)}
"""Keys of a route, with the keys that need them: expressions use `items`, a deadman sends to destinations."""


def valid_part(entry: Entry) -> Entry | None:
    """Return a payload case or gateway without its broken parts, so that the rest is still checked."""
    value = None if entry.key.broken else _valid_part(entry.value)
    return Entry(entry.key, value) if value else None


def _valid_part(node: Node) -> Node | None:
    if isinstance(node, MappingNode):
        return _valid_mapping(node)
    if node.broken:
        return None
    if isinstance(node, SequenceNode) and any(map(_has_meaning, node.items)):
        return replace(node, items=tuple(part for item in node.items if (part := _valid_part(item))))
    return node if is_valid(node) else None


def _valid_mapping(node: MappingNode) -> MappingNode | None:
    if node.broken and not _has_meaning(node):
        return None
    invalid = {key for key, entry in node.entries.items() if not (is_valid(entry.key) and is_valid(entry.value))}
    if invalid & _INDISPENSABLE:
        return None
    left_out = {user for key, users in _NEEDED_BY.items() if key in invalid for user in users}
    parts = {
        key: _valid_entry(entry) if key in invalid else entry
        for key, entry in node.entries.items()
        if key not in left_out
    }
    return replace(node, entries={key: part for key, part in parts.items() if part})


def _valid_entry(entry: Entry) -> Entry | None:
    """Return the valid part of an entry; None if it is broken as a whole, for example a mapping in place of a list."""
    if entry.value.broken or entry.key.text in _WHOLE:
        return None
    if entry.key.text == "fields" and not entry.key.broken:
        fields = _valid_fields(entry.value)
        return Entry(entry.key, fields) if fields else None
    return valid_part(entry)


def _valid_fields(node: Node) -> Node | None:
    """Return the valid fields of a message. The value of a field is valid as a whole, or not at all."""
    if node.broken:
        return None
    if not isinstance(node, MappingNode) or {MAP, TEXT} & node.entries.keys():
        return node if is_valid(node) else None
    entries = {
        name: Entry(entry.key, value)
        for name, entry in node.entries.items()
        if not entry.key.broken and (value := _valid_fields(entry.value))
    }
    return replace(node, entries=entries)


def _has_meaning(node: Node) -> bool:
    return isinstance(node, MappingNode) and any(keys <= node.entries.keys() for keys in _SUFFICIENT)

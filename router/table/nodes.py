"""A YAML document as data with positions: scalars, mappings, sequences, each with its span.

Knows no key and no meaning. `broken` marks what already has a finding, so that nobody reports it again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Union

from router.errors import SourceSpan
from router.table.places import TextPlace

Path = tuple[Union[str, int], ...]
"""How to get from a document's root to a node: keys and indexes."""

Plain = Union[None, bool, int, float, str]


@dataclass(frozen=True, slots=True)
class ScalarNode:
    """`text` is what was written, variables filled in; `value` is what YAML makes of it.

    `place` tells where each character of the text stands, as far as the file has them word for word.
    """

    span: SourceSpan
    text: str
    value: Plain
    place: TextPlace
    broken: bool = False


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
    """Entries by the text of their key, in the order of the file."""

    span: SourceSpan
    entries: Mapping[str, Entry]
    broken: bool = False

    def get(self, key: str) -> Node | None:
        entry = self.entries.get(key)
        return entry.value if entry else None


Node = Union[ScalarNode, SequenceNode, MappingNode]


def cut_off(pairs: Iterable[tuple[str, Node]]) -> Iterator[str]:
    """The keys that are none: `b)` of `{x: max(a, b)}`, where the comma ends the value of `x`."""
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
    """The same as dictionaries, lists and plain values."""
    if isinstance(node, MappingNode):
        return {key: to_data(entry.value) for key, entry in node.entries.items()}
    if isinstance(node, SequenceNode):
        return [to_data(item) for item in node.items]
    return node.value


def is_sound(node: Node) -> bool:
    """Nothing in it has a finding."""
    if node.broken:
        return False
    if isinstance(node, MappingNode):
        return all(is_sound(entry.key) and is_sound(entry.value) for entry in node.entries.values())
    return not isinstance(node, SequenceNode) or all(map(is_sound, node.items))


def marked_broken(node: Node, span: SourceSpan) -> Node:
    """A copy of the tree in which what stands at `span` is broken."""
    if node.span == span:
        return replace(node, broken=True)
    if isinstance(node, MappingNode):
        marked = {key: replace(entry, value=marked_broken(entry.value, span)) for key, entry in node.entries.items()}
        return replace(node, entries=marked)
    if isinstance(node, SequenceNode):
        return replace(node, items=tuple(marked_broken(item, span) for item in node.items))
    return node


def node_at(root: Node, path: Sequence[str | int]) -> Node:
    """The node at a path that exists."""
    for step in path:
        root = _child(root, step)
    return root


def key_at(root: Node, path: Sequence[str | int]) -> ScalarNode | None:
    """The key that the node at `path` stands under; None for the root and for a member of a sequence."""
    if not path or isinstance(path[-1], int):
        return None
    parent = node_at(root, path[:-1])
    return parent.entries[path[-1]].key if isinstance(parent, MappingNode) else None


def rewritten(node: Node, changes: Mapping[Path, Callable[[Node], Node]], here: Path = ()) -> Node:
    """A copy of the tree in which the node at each path of `changes` went through its change, children first."""
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

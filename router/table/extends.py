"""`extends`: merges the chain of files that make up a table into one tree.

Mappings merge key by key; everything else is replaced. These mappings are also replaced: values that may be a list
(such as the topics of a route) or a name (a QoS); a `map` of values; an `each`; a route or gateway that only one of the
two files ignores; a deadman that only one of them disables with `none`; a route from endpoints by one from topics, and
the reverse; the payloads of a deadman, unless both files have the same cases in the same order; what shows that a
deadman is obeyed, unless the case is the same; and the transport of a gateway. `topic` and `topics` of a route replace
each other, and so do `address`, `group` and `broadcast` of an endpoint, with the keys that belong to them. Every node
keeps the span of its own file.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

from router import inputs
from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean_file, shown_path
from router.table.compose import compose
from router.table.key_hints import as_variable
from router.table.nodes import Entry, MappingNode, Node, ScalarNode, SequenceNode
from router.table.nodes import Path as Steps
from router.table.reading import is_choice, is_elements
from router.table.source import TEST_ENDINGS, UNREADABLE, Source, read_source

KEY = "extends"
IGNORE = "ignore"
_DEPTH = len(("routes", "case"))
"""Depth of routes and gateways in a table."""
_WORDS_FOR_NONE: Mapping[Steps, str] = {(): IGNORE, ("deadman",): "none"}
"""Keys that disable a route, a gateway, or a part of one."""
_ALTERNATIVES: Mapping[str, Mapping[str, Collection[str]]] = {
    "routes": {"topic": ["topics"], "topics": ["topic"]},
    "endpoints": {
        "address": ["networks", "group", "interface", "hops", "broadcast"],
        "group": ["address", "networks", "broadcast"],
        "broadcast": ["address", "networks", "group", "interface", "hops"],
    },
}
"""Keys of a route or an endpoint, each with those that it replaces."""
_WHOLE = ("source", "destinations", "topic", "topics", "reply")
"""Keys of a route that are replaced as a whole: they take a single value or a list, or have a short form."""
_OF_ONE_KIND = {"routes": ("deadman", "send"), "gateways": ("transport",)}
"""Parts of a route or gateway whose keys select their kind."""
_OBEYED = ("deadman", "obeyed")
"""A part of a route with a payload case and `within`."""


def load_chain(
    path: Path, environ: Mapping[str, str], sources: list[Source], findings: list[Diagnostic]
) -> MappingNode:
    """Return the table at `path`, merged with all tables that it extends, without the key `extends`.

    Appends every file read to `sources`, the table first, and problems to `findings`. Raises TableError if there is no
    tree.
    """
    layers: list[MappingNode] = []
    seen: list[str] = []
    reference: ScalarNode | None = None
    while True:
        seen.append(inputs.real_path(path))
        source = _read_table(path) if reference is None else _read_base(path, reference)
        sources.append(source)
        layers.append(_root_mapping(compose(source, environ, findings)))
        reference = _reference(layers[-1])
        if reference is None:
            break
        path = path.parent / reference.text
        _refuse_cycle(path, seen, reference)
    merged = layers.pop()
    while layers:
        merged = merge(merged, layers.pop())
    return replace(merged, entries={key: entry for key, entry in merged.entries.items() if key != KEY})


def merge(base: MappingNode, over: MappingNode, here: Steps = ()) -> MappingNode:
    """Merge `over` into `base`; both are at the path `here`."""
    alternatives = _ALTERNATIVES.get(str(here[0]), {}) if len(here) == _DEPTH else {}
    replaced = {other for key in over.entries for other in alternatives.get(key, ())}
    entries = {key: entry for key, entry in base.entries.items() if key not in replaced}
    for key, entry in over.entries.items():
        below, above, path = entries[key].value if key in entries else None, entry.value, (*here, key)
        if isinstance(below, MappingNode) and isinstance(above, MappingNode) and not _replaces(above, below, path):
            entries[key] = Entry(entry.key, merge(below, above, path))
        else:
            entries[key] = entry
    return replace(over, entries=entries, broken=base.broken or over.broken)


def _replaces(over: MappingNode, base: MappingNode, path: Steps) -> bool:
    """Return whether `over` replaces `base` instead of being merged into it; see the module's docstring."""
    if path == ("defaults", "qos") or any(is_choice(node) or is_elements(node) for node in (over, base)):
        return True
    if path[0] not in _OF_ONE_KIND:
        return False
    if path[0] == "routes" and len(path) == _DEPTH + 1 and path[-1] in _WHOLE:
        return True
    if path[_DEPTH:] == _OF_ONE_KIND[path[0]]:
        return [*over.entries] != [*base.entries]
    if path[_DEPTH:] == _OBEYED:
        return not over.entries.keys() <= base.entries.keys()
    word = _WORDS_FOR_NONE.get(path[_DEPTH:]) if len(path) >= _DEPTH else None
    if word is not None and (word in over.entries) != (word in base.entries):
        return True
    return len(path) == _DEPTH and "source" in over.entries and _takes_topics(over) != _takes_topics(base)


def _takes_topics(route: MappingNode) -> bool:
    source = route.get("source")
    sources = source.items if isinstance(source, SequenceNode) else (source,)
    return any(isinstance(source, MappingNode) for source in sources)


def _root_mapping(root: Node) -> MappingNode:
    if isinstance(root, MappingNode):
        return root
    what = "a route table must be a mapping with keys such as 'version', 'listen' and 'routes'"
    raise TableError.of(root.span, Code.WRONG_TYPE, what)


def _reference(root: MappingNode) -> ScalarNode | None:
    entry = root.entries.get(KEY)
    if entry is None:
        return None
    node = entry.value
    if node.broken:
        raise TableError([])  # its finding is already in the list
    if not isinstance(node, ScalarNode) or not isinstance(node.value, str) or not node.text:
        span = node.span if isinstance(node, ScalarNode) and node.text else entry.key.span
        raise TableError.of(span, Code.WRONG_TYPE, f"'{KEY}' must be the path of another table")
    return node


def _read_table(path: Path) -> Source:
    """Read the file of a table. Raises TableError if it cannot be read, or has table tests."""
    if path.name.endswith(TEST_ENDINGS) and inputs.exists(path):
        file = shown_path(path)
        what = "this file has tests of a table, it is not a table"
        raise TableError.of(SourceSpan(file), Code.BAD_FILE, what, f"run them with `router test {file}`")
    return read_source(path)


def _read_base(path: Path, reference: ScalarNode) -> Source:
    """Read the file that a table extends. Raises TableError at the line that names it if it cannot be read."""
    try:
        return read_source(path)
    except TableError as error:
        finding = error.diagnostics[0]
        if finding.code is not Code.BAD_FILE or finding.span.end_column > finding.span.column:
            raise  # the file exists, but something in it is wrong
        what = f"'{reference.text}' cannot be extended: {finding.message.removeprefix(UNREADABLE)}"
        remedy = f"correct the path: it leads to {shown_path(Path(inputs.real_path(path)))}"
        hint = as_variable(reference.text) or did_you_mean_file(reference.text, path) or remedy
        raise TableError.of(reference.span, Code.BAD_EXTENDS, what, hint) from error


def _refuse_cycle(path: Path, seen: list[str], reference: ScalarNode) -> None:
    if (real := inputs.real_path(path)) in seen:
        names = " -> ".join(shown_path(Path(step)) for step in (*seen[seen.index(real) :], real))
        what = f"'{reference.text}' extends itself: {names}"
        raise TableError.of(reference.span, Code.BAD_EXTENDS, what, f"remove '{KEY}' from one of these tables")

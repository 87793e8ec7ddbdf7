"""A table's route map as text for Mermaid and Graphviz, and as a picture (SVG) drawn by Graphviz."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from xml.sax.saxutils import escape

from router.errors import UsageError
from router.observe.route_map import COLUMNS, Edge, Node, NodeKind, nodes_and_edges
from router.table.model import RouteTable

LEGEND: Mapping[NodeKind, str] = {
    NodeKind.ENDPOINT: "endpoint: board, basestation, tool (UDP)",
    NodeKind.ANYONE: "any sender (UDP)",
    NodeKind.CASE: "route, by its payload case",
    NodeKind.IGNORED: "ignored payload case",
    NodeKind.TOPIC: "ROS topic",
    NodeKind.GATEWAY: "gateway",
    NodeKind.CLIENTS: "clients of a gateway",
}
"""The meaning of the shapes."""
_GUARDED = "route with a ttl or a deadman"

_MERMAID_SHAPES = {
    NodeKind.ENDPOINT: ("[", "]"),
    NodeKind.ANYONE: ("[", "]"),
    NodeKind.TOPIC: ("([", "])"),
    NodeKind.CASE: (">", "]"),
    NodeKind.IGNORED: (">", "]"),
    NodeKind.GATEWAY: ("{{", "}}"),
    NodeKind.CLIENTS: ("[[", "]]"),
}
_DASHED = (NodeKind.ANYONE, NodeKind.IGNORED)
_DOT_STYLES = {
    NodeKind.ENDPOINT: 'class=endpoint, shape=box, style=bold, color="#0047b3"',
    NodeKind.ANYONE: 'class=endpoint, shape=box, style=dashed, color="#0047b3"',
    NodeKind.TOPIC: 'class=topic, shape=box, style=rounded, color="#00602b"',
    NodeKind.CASE: "shape=cds",
    NodeKind.IGNORED: "shape=cds, style=dashed",
    NodeKind.GATEWAY: 'class=gateway, shape=hexagon, color="#8a1c9c"',
    NodeKind.CLIENTS: 'class=gateway, shape=octagon, color="#8a1c9c"',
}
_DOT_GUARDED = ', class=guarded, style=bold, color="#b3261e"'
_SVG_STYLE = """<style>
:root { color-scheme: light dark; }
@media (prefers-color-scheme: dark) {
.graph > polygon { fill: #101215; } text { fill: #f2f4f7; }
.cluster polygon, .node polygon, .node path { stroke: #99a1ad; }
.endpoint polygon { stroke: #8ab4ff; } .topic path { stroke: #6fdc98; }
.gateway polygon { stroke: #dd9cf0; } .guarded polygon { stroke: #ff8a80; }
}
</style>
"""
"""Colours for a dark theme; Graphviz draws for a light background."""


def mermaid(table: RouteTable, title: str) -> str:
    nodes, edges = nodes_and_edges(table)
    return "\n".join(_mermaid_lines(nodes, edges, title)) + "\n"


def dot(table: RouteTable, title: str) -> str:
    nodes, edges = nodes_and_edges(table)
    return "\n".join(_dot_lines(nodes, edges, title)) + "\n"


def svg(table: RouteTable, title: str) -> str:
    """Return the picture, light or dark as its viewer prefers. Raises UsageError if Graphviz is not installed."""
    program = shutil.which("dot")
    if program is None:
        raise UsageError("an .svg needs Graphviz, which is not installed", "apt install graphviz")
    command = [program, "-Tsvg"]
    drawn = subprocess.run(command, input=dot(table, title), capture_output=True, encoding="utf-8", check=True)
    without_doctype = drawn.stdout[drawn.stdout.index("<svg") :]  # the doctype names another host
    head, body = without_doctype.split(">", 1)
    return f"{head}>\n{_SVG_STYLE}{body.lstrip()}"


def _mermaid_lines(nodes: Sequence[Node], edges: Sequence[Edge], title: str) -> Iterator[str]:
    names = _numbered(nodes)
    yield from ("---", f"title: {_yaml_text(title)}", "---", "flowchart LR")
    for column, head in enumerate(COLUMNS):
        yield f'  subgraph column{column}["{head}"]'
        for node in nodes:
            if node.column == column:
                yield f"    {_mermaid_node(names[node.key], node.kind, node.name)}"
        yield "  end"
    for edge in edges:
        arrow = f'-.->|"{_mermaid_text(edge.about)}"|' if edge.about else "-->"
        yield f"  {names[edge.start]} {arrow} {names[edge.end]}"
    yield '  subgraph legend["legend"]'
    for kind in _kinds(nodes):
        yield f"    {_mermaid_node(kind.value, kind, LEGEND[kind])}"
    yield "  end"
    yield "  classDef dashed stroke-dasharray: 3 3"
    if dashed := [names[node.key] for node in nodes if node.kind in _DASHED]:
        dashed += [kind.value for kind in _kinds(nodes) if kind in _DASHED]
        yield f"  class {','.join(dashed)} dashed"


def _mermaid_node(name: str, kind: NodeKind, text: str) -> str:
    opening, closing = _MERMAID_SHAPES[kind]
    return f'{name}{opening}"{_mermaid_text(text)}"{closing}'


def _kinds(nodes: Sequence[Node]) -> list[NodeKind]:
    present = {node.kind for node in nodes}
    return [kind for kind in LEGEND if kind in present]


def _dot_lines(nodes: Sequence[Node], edges: Sequence[Edge], title: str) -> Iterator[str]:
    names = _numbered(nodes)
    yield f"digraph {_dot_text(title)} {{"
    yield f"  label={_dot_text(title)}; labelloc=t; fontsize=18;"
    yield '  rankdir=LR; ranksep=2; nodesep=0.1; fontname="sans-serif";'
    yield '  node [height=0.3, fontname="sans-serif", fontsize=10];'
    yield '  edge [arrowsize=0.6, color="#7d838c", fontname="sans-serif", fontsize=8];'
    for column in range(len(COLUMNS)):
        yield "  { rank=same;"
        for node in nodes:
            if node.column == column:
                said = f"label={_dot_text(node.name)}, tooltip={_dot_text(node.about or node.name)}"
                style = f"{_DOT_STYLES[node.kind]}{_DOT_GUARDED if node.is_guarded else ''}"
                yield f"    {names[node.key]} [{said}, {style}];"
        yield "  }"
    for edge in edges:
        condition = f" [label={_dot_text(edge.about)}, style=dashed]" if edge.about else ""
        yield f"  {names[edge.start]} -> {names[edge.end]}{condition};"
    yield '  subgraph cluster_legend { label="legend"; fontsize=10;'
    for kind in _kinds(nodes):
        yield f"    {kind.value} [label={_dot_text(LEGEND[kind])}, {_DOT_STYLES[kind]}];"
    if any(node.is_guarded for node in nodes):
        yield f"    guarded [label={_dot_text(_GUARDED)}, {_DOT_STYLES[NodeKind.CASE]}{_DOT_GUARDED}];"
    yield "  }"
    yield "}"


def _numbered(nodes: Sequence[Node]) -> dict[str, str]:
    return {node.key: f"n{number}" for number, node in enumerate(nodes)}


def _yaml_text(text: str) -> str:
    """Quote for Mermaid's front matter, which is YAML."""
    return "'" + text.replace("'", "''") + "'"


def _mermaid_text(text: str) -> str:
    """Escape for Mermaid's quoted labels, which are HTML; `#` begins Mermaid's own entities."""
    return escape(text, {'"': "&quot;", "#": "&num;"})


def _dot_text(text: str) -> str:
    """Escape for Graphviz, which would read `&lt;` as one character."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("&", "&amp;")
    return f'"{escaped}"'

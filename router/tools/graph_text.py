"""A route map as text for other programs to lay out: Mermaid, which code hosts draw in a page, and Graphviz's dot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape

from router.observe.route_map import COLUMNS, Edge, Node, NodeKind, nodes_and_edges
from router.table.model import RouteTable

_MERMAID_SHAPES = {NodeKind.TOPIC: ("([", "])"), NodeKind.CLIENTS: ("([", "])"), NodeKind.ANYONE: ("((", "))")}
_DOT_STYLES = {
    NodeKind.ENDPOINT: 'color="#0047b3"',
    NodeKind.ANYONE: 'color="#0047b3", style="rounded,dashed"',
    NodeKind.TOPIC: 'color="#00602b"',
    NodeKind.IGNORED: 'style="rounded,dashed"',
    NodeKind.GATEWAY: 'color="#8a1c9c"',
    NodeKind.CLIENTS: 'color="#8a1c9c"',
}


def mermaid(table: RouteTable) -> str:
    nodes, edges = nodes_and_edges(table)
    return "\n".join(_mermaid_lines(nodes, edges)) + "\n"


def dot(table: RouteTable, title: str) -> str:
    nodes, edges = nodes_and_edges(table)
    return "\n".join(_dot_lines(nodes, edges, title)) + "\n"


def _mermaid_lines(nodes: Sequence[Node], edges: Sequence[Edge]) -> Iterator[str]:
    names = _numbered(nodes)
    yield "flowchart LR"
    for column, title in enumerate(COLUMNS):
        yield f'  subgraph column{column}["{title}"]'
        for node in nodes:
            if node.column == column:
                opening, closing = _MERMAID_SHAPES.get(node.kind, ("[", "]"))
                yield f'    {names[node.key]}{opening}"{_mermaid_text(node.name)}"{closing}'
        yield "  end"
    for edge in edges:
        condition = f'|"{_mermaid_text(edge.about)}"|' if edge.about else ""
        yield f"  {names[edge.start]} -->{condition} {names[edge.end]}"


def _dot_lines(nodes: Sequence[Node], edges: Sequence[Edge], title: str) -> Iterator[str]:
    names = _numbered(nodes)
    yield f"digraph {_dot_text(title)} {{"
    yield "  rankdir=LR; ranksep=2; nodesep=0.1;"
    yield '  node [shape=box, style=rounded, height=0.3, fontname="sans-serif", fontsize=10];'
    yield '  edge [arrowsize=0.6, color="#7d838c", fontname="sans-serif", fontsize=8];'
    for column in range(len(COLUMNS)):
        yield "  { rank=same;"
        for node in nodes:
            if node.column == column:
                said = f"label={_dot_text(node.name)}, tooltip={_dot_text(node.about or node.name)}"
                style = f", {_DOT_STYLES[node.kind]}" if node.kind in _DOT_STYLES else ""
                yield f"    {names[node.key]} [{said}{style}];"
        yield "  }"
    for edge in edges:
        condition = f" [label={_dot_text(edge.about)}]" if edge.about else ""
        yield f"  {names[edge.start]} -> {names[edge.end]}{condition};"
    yield "}"


def _numbered(nodes: Sequence[Node]) -> dict[str, str]:
    return {node.key: f"n{number}" for number, node in enumerate(nodes)}


def _mermaid_text(text: str) -> str:
    """In quotation marks Mermaid takes HTML, and anything but a quotation mark; `#` begins entities of its own."""
    return escape(text, {'"': "&quot;", "#": "&num;"})


def _dot_text(text: str) -> str:
    """Graphviz would read `&lt;` as one character."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("&", "&amp;")
    return f'"{escaped}"'

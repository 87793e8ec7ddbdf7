"""A table's route map as a picture (SVG) or as text that other programs draw (Mermaid, Graphviz)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from xml.sax.saxutils import escape, quoteattr

from router.observe.route_map import COLUMNS, Box, Curve, Edge, Node, NodeKind, RouteMap, nodes_and_edges
from router.table.model import RouteTable

_STYLE = """
.route-map { --ground: #fff; --box: #f3f4f6; --text: #000; --faint: #505050; --line: #b4b8bf; --edge: #7d838c;
  --endpoint: #0047b3; --topic: #00602b; --gateway: #8a1c9c; background: var(--ground);
  color-scheme: light dark;   /* browsers that darken pages on their own leave this one as it is */
  font-family: system-ui, "DejaVu Sans", sans-serif; }
@media (prefers-color-scheme: dark) {
  .route-map { --ground: #101215; --box: #1b1e23; --text: #f2f4f7; --faint: #a3a9b3; --line: #474d57; --edge: #7d838c;
    --endpoint: #8ab4ff; --topic: #6fdc98; --gateway: #dd9cf0; }
}
.route-map .head { fill: var(--faint); font-weight: 600; }
.route-map .node rect { fill: var(--box); stroke: var(--line); }
.route-map .node text { fill: var(--text); }
.route-map .endpoint rect, .route-map .anyone rect { stroke: var(--endpoint); }
.route-map .topic rect { stroke: var(--topic); }
.route-map .gateway rect, .route-map .clients rect { stroke: var(--gateway); }
.route-map .ignored rect { stroke-dasharray: 3 3; }
.route-map .ignored text { fill: var(--faint); }
.route-map .link { fill: none; stroke: var(--edge); stroke-width: 1.5; }
.route-map .link:hover { stroke: var(--text); }
"""


def svg(drawing: RouteMap, title: str) -> str:
    font = drawing.measures.font
    names = {box.node.key: box.node.name for box in drawing.boxes}
    width, height = f"{drawing.width:g}", f"{drawing.height:g}"
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}" font-size="{font:g}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="route-map" {size} role="img" aria-label={quoteattr(title)}>',
        f"<title>{escape(title)}</title>",
        f"<style>{_STYLE}</style>",
        *_heads(drawing),
        *(_link(curve, names) for curve in drawing.curves),
        *(_node(box, drawing) for box in drawing.boxes),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _heads(drawing: RouteMap) -> Iterator[str]:
    y = drawing.measures.head - drawing.measures.font * 0.8
    for x, text in zip(drawing.columns, COLUMNS, strict=True):
        yield f'<text class="head" x="{x + drawing.measures.pad:g}" y="{y:g}">{text}</text>'


def _link(curve: Curve, names: Mapping[str, str]) -> str:
    edge = curve.edge
    said = f"{names[edge.start]} to {names[edge.end]}" + (f"\n{edge.about}" if edge.about else "")
    return f'<path class="link" d="{curve.path}"><title>{escape(said)}</title></path>'


def _node(box: Box, drawing: RouteMap) -> str:
    node, pad = box.node, drawing.measures.pad
    baseline = box.y + box.height / 2 + drawing.measures.font * 0.35
    said = f"{node.name}\n{node.about}" if node.about else node.name
    return (
        f'<g class="node {node.kind.value}"><title>{escape(said)}</title>'
        f'<rect x="{box.x:g}" y="{box.y:g}" width="{box.width:g}" height="{box.height:g}" rx="4"/>'
        f'<text x="{box.x + pad:g}" y="{baseline:g}">{escape(box.label)}</text></g>'
    )


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
    """Escaped for Mermaid's quoted labels, which are HTML; `#` begins Mermaid's own entities."""
    return escape(text, {'"': "&quot;", "#": "&num;"})


def _dot_text(text: str) -> str:
    """Escaped for Graphviz, which would read `&lt;` as one character."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("&", "&amp;")
    return f'"{escaped}"'

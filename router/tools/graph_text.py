"""A route map as text for other programs to lay out: Mermaid, which code hosts draw in a page, and Graphviz's dot.

Knows the map's parts and ties only; our own drawing is `graph_svg`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape

from router.observe.route_map import COLUMNS, Part, PartKind, Tie, map_parts
from router.table.model import RouteTable

_MERMAID_SHAPES = {PartKind.TOPIC: ("([", "])"), PartKind.CLIENTS: ("([", "])"), PartKind.ANYONE: ("((", "))")}
_DOT_STYLES = {
    PartKind.ENDPOINT: 'color="#0047b3"',
    PartKind.ANYONE: 'color="#0047b3", style="rounded,dashed"',
    PartKind.TOPIC: 'color="#00602b"',
    PartKind.IGNORED: 'style="rounded,dashed"',
    PartKind.GATEWAY: 'color="#8a1c9c"',
    PartKind.CLIENTS: 'color="#8a1c9c"',
}


def mermaid(table: RouteTable) -> str:
    parts, ties = map_parts(table)
    return "\n".join(_mermaid_lines(parts, ties)) + "\n"


def dot(table: RouteTable, title: str) -> str:
    parts, ties = map_parts(table)
    return "\n".join(_dot_lines(parts, ties, title)) + "\n"


def _mermaid_lines(parts: Sequence[Part], ties: Sequence[Tie]) -> Iterator[str]:
    names = _numbered(parts)
    yield "flowchart LR"
    for column, title in enumerate(COLUMNS):
        yield f'  subgraph column{column}["{title}"]'
        for part in parts:
            if part.column == column:
                opening, closing = _MERMAID_SHAPES.get(part.kind, ("[", "]"))
                yield f'    {names[part.key]}{opening}"{_mermaid_text(part.name)}"{closing}'
        yield "  end"
    for tie in ties:
        condition = f'|"{_mermaid_text(tie.about)}"|' if tie.about else ""
        yield f"  {names[tie.start]} -->{condition} {names[tie.end]}"


def _dot_lines(parts: Sequence[Part], ties: Sequence[Tie], title: str) -> Iterator[str]:
    names = _numbered(parts)
    yield f"digraph {_dot_text(title)} {{"
    yield "  rankdir=LR; ranksep=2; nodesep=0.1;"
    yield '  node [shape=box, style=rounded, height=0.3, fontname="sans-serif", fontsize=10];'
    yield '  edge [arrowsize=0.6, color="#7d838c", fontname="sans-serif", fontsize=8];'
    for column in range(len(COLUMNS)):
        yield "  { rank=same;"
        for part in parts:
            if part.column == column:
                said = f"label={_dot_text(part.name)}, tooltip={_dot_text(part.about or part.name)}"
                style = f", {_DOT_STYLES[part.kind]}" if part.kind in _DOT_STYLES else ""
                yield f"    {names[part.key]} [{said}{style}];"
        yield "  }"
    for tie in ties:
        condition = f" [label={_dot_text(tie.about)}]" if tie.about else ""
        yield f"  {names[tie.start]} -> {names[tie.end]}{condition};"
    yield "}"


def _numbered(parts: Sequence[Part]) -> dict[str, str]:
    return {part.key: f"n{number}" for number, part in enumerate(parts)}


def _mermaid_text(text: str) -> str:
    """In quotation marks Mermaid takes HTML, and anything but a quotation mark; `#` begins entities of its own."""
    return escape(text, {'"': "&quot;", "#": "&num;"})


def _dot_text(text: str) -> str:
    """Graphviz would read `&lt;` as one character."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("&", "&amp;")
    return f'"{escaped}"'

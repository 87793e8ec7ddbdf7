"""A table's route map as a picture (SVG) with a title and a legend.

Each kind of node has its own shape, so that nothing is told by colour alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from router.observe.route_map import COLUMNS, Edge, NodeKind
from router.tools.graph import LEGEND
from router.tools.graph_layout import FONT, HEAD, LETTER, PAD, Box, Curve, RouteMap

_STYLE = """
.route-map { --ground: #fff; --box: #f3f4f6; --text: #000; --faint: #505050; --line: #5d6470;
  --endpoint: #0047b3; --topic: #00602b; --gateway: #8a1c9c; --halt: #b3261e; background: var(--ground);
  color-scheme: light dark;   /* browsers that darken pages on their own leave this one as it is */
  font-family: system-ui, "DejaVu Sans", sans-serif; }
@media (prefers-color-scheme: dark) {
  .route-map { --ground: #101215; --box: #1b1e23; --text: #f2f4f7; --faint: #a3a9b3; --line: #99a1ad;
    --endpoint: #8ab4ff; --topic: #6fdc98; --gateway: #dd9cf0; --halt: #ff8a80; }
}
.route-map .ground { fill: var(--ground); }
.route-map text { fill: var(--text); }
.route-map .name { font-size: 1.5em; font-weight: 600; }
.route-map .head { fill: var(--faint); font-weight: 600; }
.route-map .about, .route-map .legend text { fill: var(--faint); }
.route-map .shape { fill: var(--box); stroke: var(--line); stroke-width: 1.2; }
.route-map .endpoint .shape, .route-map .anyone .shape { stroke: var(--endpoint); stroke-width: 2; }
.route-map .topic .shape { stroke: var(--topic); }
.route-map .gateway .shape, .route-map .clients .shape { stroke: var(--gateway); }
.route-map .ignored .shape, .route-map .anyone .shape { stroke-dasharray: 3 3; }
.route-map .ignored text { fill: var(--faint); }
.route-map .halt { fill: var(--halt); }
.route-map .link { fill: none; stroke: var(--edge); stroke-width: 1.4; }
.route-map .tip { fill: var(--edge); }
.route-map .to-endpoint { --edge: var(--endpoint); } .route-map .to-topic { --edge: var(--topic); }
.route-map .to-gateway { --edge: var(--gateway); }
.route-map .if .link { stroke-dasharray: 6 3; }
.route-map .edge:hover { --edge: var(--text); }
"""

_MARGIN = 16
_INSET = 7
"""How far tips and cut corners reach into a box."""

_TIP = 7
"""Length of an arrow's head."""

_SAMPLE = 30
"""Width of a shape in the legend."""

_GUARDED = "has a ttl or a deadman"
_CONDITION = "not every message (when, max_rate)"
_FLOWS = {
    "endpoint": "datagrams from or to an endpoint",
    "topic": "messages from or to a topic",
    "gateway": "messages of gateway clients",
}
_CLASSES = {
    NodeKind.ENDPOINT: "endpoint",
    NodeKind.ANYONE: "endpoint",
    NodeKind.TOPIC: "topic",
    NodeKind.GATEWAY: "gateway",
    NodeKind.CLIENTS: "gateway",
}


def svg(drawing: RouteMap, title: str, about: str = "") -> str:
    """The drawing below a title, a line about it, and the legend."""
    kinds = {box.node.key: box.node.kind for box in drawing.boxes}
    names = {box.node.key: box.node.name for box in drawing.boxes}
    width = max(drawing.width, 480.0)
    line = FONT * 1.8
    legend = _placed(_legend(drawing), width)
    top = _MARGIN + line + (line if about else 0)
    start = top + line * (1 + max(entry.row for entry in legend)) + FONT
    size = width + 2 * _MARGIN, start + drawing.height + _MARGIN
    whole = f'viewBox="0 0 {size[0]:g} {size[1]:g}" width="{size[0]:g}" height="{size[1]:g}"'
    label = f'font-size="{FONT:g}" role="img" aria-label={quoteattr(f"Route map of {title}")}'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="route-map" {whole} {label}>',
        f"<title>{escape(title)}</title>",
        f"<style>{_STYLE}</style>",
        '<rect class="ground" width="100%" height="100%"/>',
        f'<text class="name" x="{_MARGIN}" y="{_MARGIN + FONT:g}">{escape(title)}</text>',
    ]
    if about:
        lines.append(f'<text class="about" x="{_MARGIN}" y="{_MARGIN + line + FONT:g}">{escape(about)}</text>')
    lines += [
        f'<g class="legend" transform="translate({_MARGIN},{top:g})">',
        *(_legend_entry(entry, line) for entry in legend),
        "</g>",
        f'<g transform="translate({_MARGIN + (width - drawing.width) / 2:g},{start:g})">',
        *_heads(drawing),
        *(_link(curve, names, kinds) for curve in drawing.curves),
        *(_node(box) for box in drawing.boxes),
        "</g>",
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class _Entry:
    """A line of the legend: a sample, as SVG in a box of `_SAMPLE` by a row, and what it means."""

    sample: str
    text: str
    x: float = 0
    row: int = 0


def _legend(drawing: RouteMap) -> list[_Entry]:
    """What occurs in the drawing."""
    row = FONT * 1.2
    present = {box.node.kind for box in drawing.boxes}
    entries = [
        _Entry(f'<g class="{kind.value}">{_shape(kind, 0, 0, _SAMPLE, row)}</g>', text)
        for kind, text in LEGEND.items()
        if kind in present
    ]
    if any(box.node.is_guarded for box in drawing.boxes):
        entries.append(_Entry(_halt(_SAMPLE / 2, row / 2), _GUARDED))
    kinds = {box.node.key: box.node.kind for box in drawing.boxes}
    flows = {_flow(curve.edge, kinds) for curve in drawing.curves}
    arrow = f'<path class="link" d="M0,{row / 2:g}H{_SAMPLE - _TIP}"/>{_tip(_SAMPLE, row / 2)}'
    entries += [
        _Entry(f'<g class="edge to-{flow}">{arrow}</g>', text) for flow, text in _FLOWS.items() if flow in flows
    ]
    if any(curve.edge.about for curve in drawing.curves):
        entries.append(_Entry(f'<g class="edge if to-endpoint">{arrow}</g>', _CONDITION))
    return entries


def _placed(entries: Sequence[_Entry], width: float) -> list[_Entry]:
    """The entries beside each other in columns, in as many rows as they need."""
    longest = max((len(entry.text) for entry in entries), default=0)
    column = _SAMPLE + 8 + longest * LETTER + 12
    columns = max(int(width // column), 1)
    rows = -(-len(entries) // columns)
    return [
        _Entry(entry.sample, entry.text, index // rows * width / columns, index % rows)
        for index, entry in enumerate(entries)
    ] or [_Entry("", "")]


def _legend_entry(entry: _Entry, line: float) -> str:
    x, y = entry.x, entry.row * line + FONT * 0.4
    text = f'<text x="{_SAMPLE + 8}" y="{FONT:g}">{escape(entry.text)}</text>'
    return f'<g transform="translate({x:g},{y:g})">{entry.sample}{text}</g>'


def _heads(drawing: RouteMap) -> Iterator[str]:
    y = HEAD - FONT * 0.8
    for x, text in zip(drawing.columns, COLUMNS, strict=True):
        yield f'<text class="head" x="{x + PAD:g}" y="{y:g}">{text}</text>'


def _flow(edge: Edge, kinds: Mapping[str, NodeKind]) -> str:
    """Whose messages an edge carries: of the end that is no route."""
    ends = [_CLASSES.get(kinds[key], "") for key in (edge.start, edge.end)]
    if "gateway" in ends and "topic" in ends:
        return "topic"
    return next(filter(None, ends), "gateway")


def _link(curve: Curve, names: Mapping[str, str], kinds: Mapping[str, NodeKind]) -> str:
    """From below the first box, whose right side need not be straight, to the point of the arrow."""
    edge = curve.edge
    said = f"{names[edge.start]} to {names[edge.end]}" + (f"\n{edge.about}" if edge.about else "")
    start, end = curve.x0, curve.x1 - _TIP + 1
    middle = (start + end) / 2
    bend = f"{middle:g},{curve.y0:g} {middle:g},{curve.y1:g} {end:g},{curve.y1:g}"
    path = f"M{start - _INSET:g},{curve.y0:g}H{start:g}C{bend}"
    return (
        f'<g class="edge to-{_flow(edge, kinds)}{" if" if edge.about else ""}"><title>{escape(said)}</title>'
        f'<path class="link" d="{path}"/>{_tip(curve.x1, curve.y1)}</g>'
    )


def _tip(x: float, y: float) -> str:
    return f'<polygon class="tip" points="{x:g},{y:g} {x - _TIP:g},{y - 3:g} {x - _TIP:g},{y + 3:g}"/>'


def _node(box: Box) -> str:
    node = box.node
    baseline = box.y + box.height / 2 + FONT * 0.35
    said = f"{node.name}\n{node.about}" if node.about else node.name
    mark = _halt(box.x + box.width - PAD - 5, box.y + box.height / 2) if node.is_guarded else ""
    return (
        f'<g class="node {node.kind.value}"><title>{escape(said)}</title>'
        f"{_shape(node.kind, box.x, box.y, box.width, box.height)}"
        f'<text x="{box.x + PAD:g}" y="{baseline:g}">{escape(box.label)}</text>{mark}</g>'
    )


def _halt(x: float, y: float) -> str:
    """A stop sign around `x, y`."""
    return f'<polygon class="halt" points="{_points(x - 5, y - 5, _octagon(10, 10, 3))}"/>'


def _shape(kind: NodeKind, x: float, y: float, width: float, height: float) -> str:
    """Endpoints are rectangles, topics round, routes point right, gateways are hexagons, clients have cut corners."""
    cut, middle = _INSET, height / 2
    if kind in (NodeKind.CASE, NodeKind.IGNORED):
        corners = [(0, 0), (width - cut, 0), (width, middle), (width - cut, height), (0, height)]
    elif kind is NodeKind.GATEWAY:
        corners = [(cut, 0), (width - cut, 0), (width, middle), (width - cut, height), (cut, height), (0, middle)]
    elif kind is NodeKind.CLIENTS:
        corners = _octagon(width, height, cut - 2)
    else:
        radius = f' rx="{min(height / 2, 11):g}"' if kind is NodeKind.TOPIC else ""
        return f'<rect class="shape" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}"{radius}/>'
    return f'<polygon class="shape" points="{_points(x, y, corners)}"/>'


def _octagon(width: float, height: float, cut: float) -> list[tuple[float, float]]:
    right, low = width - cut, height - cut
    return [(cut, 0), (right, 0), (width, cut), (width, low), (right, height), (cut, height), (0, low), (0, cut)]


def _points(x: float, y: float, corners: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x + right:g},{y + down:g}" for right, down in corners)

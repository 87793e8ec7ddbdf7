"""A route map as an SVG picture: boxes, and lines between them, with what there is to know of each under the pointer.

Stands alone: it refers to nothing outside itself, and is light or dark where its viewer is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from xml.sax.saxutils import escape, quoteattr

from router.observe.route_map import COLUMNS, Link, Node, RouteMap

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
    names = {node.part.key: node.part.name for node in drawing.nodes}
    width, height = f"{drawing.width:g}", f"{drawing.height:g}"
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}" font-size="{font:g}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="route-map" {size} role="img" aria-label={quoteattr(title)}>',
        f"<title>{escape(title)}</title>",
        f"<style>{_STYLE}</style>",
        *_heads(drawing),
        *(_link(link, names) for link in drawing.links),
        *(_node(node, drawing) for node in drawing.nodes),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _heads(drawing: RouteMap) -> Iterator[str]:
    y = drawing.measures.head - drawing.measures.font * 0.8
    for x, text in zip(drawing.columns, COLUMNS, strict=True):
        yield f'<text class="head" x="{x + drawing.measures.pad:g}" y="{y:g}">{text}</text>'


def _link(link: Link, names: Mapping[str, str]) -> str:
    tie = link.tie
    said = f"{names[tie.start]} to {names[tie.end]}" + (f"\n{tie.about}" if tie.about else "")
    return f'<path class="link" d="{link.path}"><title>{escape(said)}</title></path>'


def _node(node: Node, drawing: RouteMap) -> str:
    part, pad = node.part, drawing.measures.pad
    baseline = node.y + node.height / 2 + drawing.measures.font * 0.35
    said = f"{part.name}\n{part.about}" if part.about else part.name
    return (
        f'<g class="node {part.kind.value}"><title>{escape(said)}</title>'
        f'<rect x="{node.x:g}" y="{node.y:g}" width="{node.width:g}" height="{node.height:g}" rx="4"/>'
        f'<text x="{node.x + pad:g}" y="{baseline:g}">{escape(node.label)}</text></g>'
    )

"""Where boxes and lines of a route map stand in the picture of `router graph`, in units of a pixel."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.observe.route_map import COLUMNS, Edge, Node, nodes_and_edges
from router.table.model import RouteTable
from router.values import shortened

FONT = 12.0
LETTER = 7.0
"""How wide a letter is on average."""
MOST_LETTERS = 36
"""Of a name that are shown."""
PAD = 8.0
HEAD = 24.0
_ROW = 22.0
_BETWEEN = 5.0
_GAP = 120.0
"""Between two columns."""
_PORT = 6.0
"""Between lines that meet a box on the same side."""
_MARGIN = 1.0
"""For the borders of boxes."""


@dataclass(frozen=True, slots=True)
class Box:
    """A node's place in the drawing. `label`: what of its name has room. `x`, `y`: the top left corner."""

    node: Node
    label: str
    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Curve:
    """An edge's line, from the right side of a box at `x0, y0` to the left side of another at `x1, y1`."""

    edge: Edge
    x0: float
    y0: float
    x1: float
    y1: float


@dataclass(frozen=True, slots=True)
class RouteMap:
    """The drawing. `columns`: the left edges of the three columns."""

    boxes: tuple[Box, ...]
    curves: tuple[Curve, ...]
    width: float
    height: float
    columns: tuple[float, ...]


def route_map(table: RouteTable) -> RouteMap:
    """Lay a table out. Cases keep the order of the table; sources and targets are placed beside their cases."""
    nodes, edges = nodes_and_edges(table)
    columns = [[node for node in nodes if node.column == column] for column in range(len(COLUMNS))]
    places = {node.key: float(index) for index, node in enumerate(columns[1])}
    for column in (0, 2):
        columns[column].sort(key=lambda node: _mean(_others(node.key, edges, places)))
    heights = {node.key: _height(node, edges) for node in nodes}
    tops = _tops(columns, edges, heights)
    spans = _spans(columns)
    boxes = {
        node.key: Box(node, shortened(node.name, MOST_LETTERS), x, HEAD + tops[node.key], width, heights[node.key])
        for column, (x, width) in zip(columns, spans, strict=True)
        for node in column
    }
    bottom = max((box.y + box.height for box in boxes.values()), default=HEAD)
    return RouteMap(
        boxes=tuple(boxes.values()),
        curves=tuple(_curves(edges, boxes)),
        width=spans[-1][0] + spans[-1][1] + _MARGIN,
        height=bottom + _BETWEEN,
        columns=tuple(x for x, _ in spans),
    )


def _height(node: Node, edges: Sequence[Edge]) -> float:
    """Return a row, or more where so many edges meet on one side that they need it."""
    busiest = max(sum(edge.start == node.key for edge in edges), sum(edge.end == node.key for edge in edges))
    return max(_ROW, busiest * _PORT)


def _spans(columns: Sequence[Sequence[Node]]) -> list[tuple[float, float]]:
    """Left edge and width of each column."""
    widths = [
        max((len(shortened(node.name, MOST_LETTERS)) for node in column), default=0) * LETTER + 2 * PAD
        for column in columns
    ]
    return [(_MARGIN + sum(widths[:index]) + _GAP * index, width) for index, width in enumerate(widths)]


def _tops(columns: Sequence[Sequence[Node]], edges: Sequence[Edge], heights: Mapping[str, float]) -> dict[str, float]:
    """Return how far each node is below the head: cases at even distances, the others beside their neighbours."""
    sizes = [[heights[node.key] + _BETWEEN for node in column] for column in columns]
    room = max(map(sum, sizes))
    spare = (room - sum(sizes[1])) / max(len(sizes[1]) - 1, 1)
    tops = {node.key: sum(sizes[1][:index]) + spare * index for index, node in enumerate(columns[1])}
    centres = {key: top + heights[key] / 2 for key, top in tops.items()}
    for column in (0, 2):
        keys = [node.key for node in columns[column]]
        wanted = [_mean(_others(key, edges, centres)) - heights[key] / 2 for key in keys]
        tops.update(zip(keys, spread(wanted, sizes[column], room), strict=True))
    return {key: round(top, 1) for key, top in tops.items()}


def spread(wanted: Sequence[float], sizes: Sequence[float], room: float) -> list[float]:
    """Tops as near as possible to those `wanted`, in their order, none above the end of the one before, all in `room`.

    Neighbours that would overlap are moved together, to where the squares of their distances are least.
    """
    before = [sum(sizes[:index]) for index in range(len(sizes))]
    blocks: list[list[float]] = []
    for want, offset in zip(wanted, before, strict=True):
        blocks.append([want - offset])
        while len(blocks) > 1 and _mean(blocks[-2]) > _mean(blocks[-1]):
            last = blocks.pop()
            blocks[-1] += last
    highest = room - sum(sizes)
    shifts = [min(max(_mean(block), 0.0), highest) for block in blocks for _ in block]
    return [offset + shift for offset, shift in zip(before, shifts, strict=True)]


def _others(key: str, edges: Iterable[Edge], places: Mapping[str, float]) -> list[float]:
    """Return the places of the neighbours of `key` that have one already."""
    ends = [edge.end if edge.start == key else edge.start for edge in edges if key in (edge.start, edge.end)]
    return [places[end] for end in ends if end in places]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def _curves(edges: Sequence[Edge], boxes: Mapping[str, Box]) -> Iterator[Curve]:
    starts = _ports([(edge.start, edge.end) for edge in edges], boxes)
    ends = _ports([(edge.end, edge.start) for edge in edges], boxes)
    for edge, y0, y1 in zip(edges, starts, ends, strict=True):
        yield Curve(edge, boxes[edge.start].x + boxes[edge.start].width, y0, boxes[edge.end].x, y1)


def _ports(ends: Sequence[tuple[str, str]], boxes: Mapping[str, Box]) -> list[float]:
    """Return how high each edge, of which a box and the one at its other end are given, meets the box.

    Those that meet there stand beside each other in the order of their other ends, and cross less.
    """
    heights = [0.0] * len(ends)
    for key, box in boxes.items():
        met = [index for index, (own, _) in enumerate(ends) if own == key]
        met.sort(key=lambda index: boxes[ends[index][1]].y)
        first = box.y + box.height / 2 - _PORT * (len(met) - 1) / 2
        for place, index in enumerate(met):
            heights[index] = first + _PORT * place
    return heights

"""The map of a route table: what sends what to whom, for the status page and `router graph`; and a layout for `graph`.

Sources are on the left, payload cases in the middle, targets on the right. Edges carry the labels under which the
metrics count what goes over them.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.metrics import CLIENTS
from router.compiler.topics import resolved
from router.table.keys import phrases
from router.table.model import ANY, ROS, Destination, Endpoint, Gateway, Route, RouteTable, Topic
from router.table.units import duration

COLUMNS = ("from", "payload case", "to")
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


class NodeKind(enum.Enum):
    ENDPOINT = "endpoint"
    ANYONE = "anyone"
    TOPIC = "topic"
    CASE = "case"
    IGNORED = "ignored"
    GATEWAY = "gateway"
    CLIENTS = "clients"


@dataclass(frozen=True, slots=True)
class Node:
    """An endpoint, a topic, a payload case, a gateway or its clients, in a column of the map.

    `key` is unique in a map. `about` says in a few words what the name does not: an address, a type, a ttl.
    Endpoints have an `address` and a `role`, as in `kind: board`; clients of a gateway have an `address`. A
    payload case `is_guarded` by a ttl or a deadman.
    """

    key: str
    column: int
    kind: NodeKind
    name: str
    about: str = ""
    address: str = ""
    role: str = ""
    is_guarded: bool = False


@dataclass(frozen=True, slots=True)
class Edge:
    """Messages go from one node to another, named by their keys.

    `route` and `label` are those of the metrics. An edge to a case is counted as
    `messages_received{route, source=label}`, for ANY the sum over all sources; one from a case as `datagrams_sent`
    or `messages_published`; a gateway's to its clients as `messages_sent`. `about` says under which conditions.
    """

    start: str
    end: str
    route: str
    label: str
    about: str = ""


def nodes_and_edges(table: RouteTable) -> tuple[list[Node], list[Edge]]:
    """Everything that the table names in a route or a gateway, each once in a column, in the order of the table."""
    nodes: dict[str, Node] = {}
    edges: list[Edge] = []
    for route in table.routes:
        for node in (_case(route), *_sources(route, table), *_targets(route, table)):
            nodes.setdefault(node.key, node)
        edges += _edges_of(route)
    for gateway in table.gateways.values():
        for node in _gateway_nodes(gateway, table):
            nodes.setdefault(node.key, node)
        edges += _gateway_edges(gateway, table)
    return list(nodes.values()), edges


def _case(route: Route) -> Node:
    case = route.case.value
    if route.ignore is not None:
        return Node(f"case:{case}", 1, NodeKind.IGNORED, case, f"ignored: {route.ignore}")
    words = []
    if route.ttl is not None:
        words.append(f"dropped when older than {duration(route.ttl.value)}")
    if route.deadman is not None:
        words.append(f"deadman after {duration(route.deadman.timeout.value)}")
    if route.collect is not None:
        words.append("collected to frames")
    is_guarded = route.ttl is not None or route.deadman is not None
    return Node(f"case:{case}", 1, NodeKind.CASE, case, ", ".join(words), is_guarded=is_guarded)


def _sources(route: Route, table: RouteTable) -> Iterator[Node]:
    if route.ignore is not None:
        return
    for topic in route.source_topics:
        yield Node(f"from:{topic.topic.value}", 0, NodeKind.TOPIC, topic.topic.value, topic.type_name)
    for source in route.sources:
        if source.value == ANY:
            yield Node(f"from:@{ANY}", 0, NodeKind.ANYONE, "any sender")
        else:
            yield _endpoint(table.endpoints[source.value], "from", 0)


def _targets(route: Route, table: RouteTable) -> Iterator[Node]:
    for destination in route.destinations:
        yield _endpoint(table.endpoints[destination.endpoint.value], "to", 2)
    for topic in route.topics:
        yield Node(f"to:{topic.topic.value}", 2, NodeKind.TOPIC, topic.topic.value, topic.type_name)


def _endpoint(endpoint: Endpoint, side: str, column: int) -> Node:
    address, role = str(endpoint.address.value), endpoint.kind.value
    return Node(
        f"{side}:@{endpoint.name}", column, NodeKind.ENDPOINT, endpoint.name, f"{role}, {address}", address, role
    )


def _edges_of(route: Route) -> Iterator[Edge]:
    case = f"case:{route.case.value}"
    if route.ignore is not None:
        return
    for topic in route.source_topics:
        yield Edge(f"from:{topic.topic.value}", case, route.name, topic.topic.value, _condition(topic))
    for source in (source.value for source in route.sources):
        yield Edge(f"from:@{source}", case, route.name, source)
    for destination in route.destinations:
        name = destination.endpoint.value
        yield Edge(case, f"to:@{name}", route.name, name, _condition(destination))
    for topic in route.topics:
        name = topic.topic.value
        yield Edge(case, f"to:{name}", route.name, name, _condition(topic))


def _condition(target: Destination | Topic) -> str:
    return ", ".join(" ".join(words.split()) for key, words in phrases(target).items() if key != "on_limit")


def _gateway_nodes(gateway: Gateway, table: RouteTable) -> Iterator[Node]:
    yield Node(_key(gateway), 1, NodeKind.GATEWAY, gateway.name, f"gateway, {gateway.transport.value.value}")
    included = ", ".join(pattern.text for pattern in gateway.include) or "all"
    excluded = ", ".join(pattern.text for pattern in gateway.exclude)
    about = f"{included} but {excluded}" if excluded else included
    yield Node(f"from:{_key(gateway)}", 0, NodeKind.TOPIC, "ROS topics", about)
    place = str(gateway.address.value if gateway.address is not None else gateway.transport.value.value)
    yield Node(f"to:{_key(gateway)}", 2, NodeKind.CLIENTS, f"clients of {gateway.name}", place, place)
    for inbound in gateway.inbound:
        yield Node(f"clients:{_key(gateway)}", 0, NodeKind.CLIENTS, f"clients of {gateway.name}", place, place)
        name = resolved(inbound.topic.topic.value, table.node)
        yield Node(f"to:{name}", 2, NodeKind.TOPIC, name, inbound.topic.type_name)


def _gateway_edges(gateway: Gateway, table: RouteTable) -> Iterator[Edge]:
    key = _key(gateway)
    yield Edge(f"from:{key}", key, gateway.name, ROS)
    yield Edge(key, f"to:{key}", gateway.name, CLIENTS)
    if gateway.inbound:
        yield Edge(f"clients:{key}", key, gateway.name, CLIENTS)
    for inbound in gateway.inbound:
        name = resolved(inbound.topic.topic.value, table.node)
        yield Edge(key, f"to:{name}", gateway.name, name, _condition(inbound.topic))


def _key(gateway: Gateway) -> str:
    return f"gateway:{gateway.name}"


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
        node.key: Box(node, shortened(node.name), x, HEAD + tops[node.key], width, heights[node.key])
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


def shortened(name: str, letters: int = MOST_LETTERS) -> str:
    """The name with its middle left out where it is too long: what names differ in is mostly at an end."""
    if len(name) <= letters:
        return name
    kept = letters - 1
    return f"{name[: kept - kept // 2]}…{name[len(name) - kept // 2 :]}"


def _height(node: Node, edges: Sequence[Edge]) -> float:
    """Return a row, or more where so many edges meet on one side that they need it."""
    busiest = max(sum(edge.start == node.key for edge in edges), sum(edge.end == node.key for edge in edges))
    return max(_ROW, busiest * _PORT)


def _spans(columns: Sequence[Sequence[Node]]) -> list[tuple[float, float]]:
    """Left edge and width of each column."""
    widths = [max((len(shortened(node.name)) for node in column), default=0) * LETTER + 2 * PAD for column in columns]
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

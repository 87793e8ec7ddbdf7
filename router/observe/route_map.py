"""A drawing of a route table: sources on the left, payload cases in the middle, targets on the right.

For the status page and `router graph`. Links carry the labels under which the metrics count what they stand for.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from router.compiler.metrics import CLIENTS
from router.compiler.topics import resolved
from router.table.keys import phrases
from router.table.model import ANY, ROS, Destination, Endpoint, Gateway, Route, RouteTable, Topic
from router.table.units import duration

COLUMNS = ("from", "payload case", "to")
_MARGIN = 1
"""For the borders of boxes."""


class Measures(NamedTuple):
    """Sizes of a drawing. `letter` is how wide one is on average, `letters` how many of a name are shown at most,
    `gap` the least room between two columns, `port` how thick a link may become."""

    width: float = 0
    font: float = 12
    letter: float = 7
    letters: int = 36
    pad: float = 8
    row: float = 22
    between: float = 5
    gap: float = 120
    port: float = 6
    head: float = 24


WIDE = Measures()
NARROW = Measures(width=390, font=10, letter=5.8, letters=18, pad=4, row=20, between=4, gap=24, port=4, head=20)
"""For a phone that is held upright."""


@dataclass(frozen=True, slots=True)
class Node:
    """A box. `part` says what it stands for, `label` what of its name has room. `x`, `y` are its top left corner."""

    part: Part
    label: str
    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Link:
    """A line from the right side of a box to the left side of another, `x0, y0` to `x1, y1`."""

    tie: Tie
    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def path(self) -> str:
        """A level beginning and end with a bend between, as an SVG path."""
        middle = (self.x0 + self.x1) / 2
        return f"M{self.x0:g},{self.y0:g}C{middle:g},{self.y0:g} {middle:g},{self.y1:g} {self.x1:g},{self.y1:g}"


@dataclass(frozen=True, slots=True)
class RouteMap:
    """The drawing. `columns` are the left edges of the three columns, `measures` what it was made with."""

    nodes: tuple[Node, ...]
    links: tuple[Link, ...]
    width: float
    height: float
    columns: tuple[float, ...]
    measures: Measures


class _Side(enum.IntEnum):
    """Which end of a tie a part is."""

    START = 0
    END = 1


def route_map(table: RouteTable, measures: Measures = WIDE) -> RouteMap:
    """Lay a table out. Cases keep the order of the table; the rest stands beside what it is tied to."""
    parts, ties = map_parts(table)
    columns = [[part for part in parts if part.column == column] for column in range(len(COLUMNS))]
    places = {part.key: float(index) for index, part in enumerate(columns[1])}
    for column in (0, 2):
        columns[column].sort(key=lambda part: _mean(_others(part.key, ties, places)))
    heights = {part.key: _height(part, ties, measures) for part in parts}
    tops = _tops(columns, ties, heights, measures)
    edges = _edges(columns, measures)
    nodes = {
        part.key: Node(
            part, shortened(part.name, measures.letters), x, measures.head + tops[part.key], width, heights[part.key]
        )
        for column, (x, width) in zip(columns, edges, strict=True)
        for part in column
    }
    bottom = max((node.y + node.height for node in nodes.values()), default=measures.head)
    return RouteMap(
        nodes=tuple(nodes.values()),
        links=tuple(_links(ties, nodes, measures)),
        width=edges[-1][0] + edges[-1][1] + _MARGIN,
        height=bottom + measures.between,
        columns=tuple(x for x, _ in edges),
        measures=measures,
    )


def shortened(name: str, letters: int) -> str:
    """The name with its middle left out where it is too long: what names differ in is mostly at an end."""
    if len(name) <= letters:
        return name
    kept = letters - 1
    return f"{name[: kept - kept // 2]}…{name[len(name) - kept // 2 :]}"


def _height(part: Part, ties: Sequence[Tie], measures: Measures) -> float:
    """A row, or more where so many links meet on one side that they need it."""
    busiest = max(sum(tie.start == part.key for tie in ties), sum(tie.end == part.key for tie in ties))
    return max(measures.row, busiest * measures.port)


def _edges(columns: Sequence[Sequence[Part]], measures: Measures) -> list[tuple[float, float]]:
    """Left edge and width of each column; what is left of `measures.width` goes between them."""
    widths = [
        max((len(shortened(part.name, measures.letters)) for part in column), default=0) * measures.letter
        + 2 * measures.pad
        for column in columns
    ]
    gap = max(measures.gap, (measures.width - 2 * _MARGIN - sum(widths)) / (len(columns) - 1))
    return [(_MARGIN + sum(widths[:index]) + gap * index, width) for index, width in enumerate(widths)]


def _tops(
    columns: Sequence[Sequence[Part]], ties: Sequence[Tie], heights: Mapping[str, float], measures: Measures
) -> dict[str, float]:
    """How far each part is below the head: the cases at even distances, the others beside what they are tied to."""
    sizes = [[heights[part.key] + measures.between for part in column] for column in columns]
    room = max(map(sum, sizes))
    spare = (room - sum(sizes[1])) / max(len(sizes[1]) - 1, 1)
    tops = {part.key: sum(sizes[1][:index]) + spare * index for index, part in enumerate(columns[1])}
    centres = {key: top + heights[key] / 2 for key, top in tops.items()}
    for column in (0, 2):
        keys = [part.key for part in columns[column]]
        wanted = [_mean(_others(key, ties, centres)) - heights[key] / 2 for key in keys]
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


def _others(key: str, ties: Iterable[Tie], places: Mapping[str, float]) -> list[float]:
    """Where that is to which `key` is tied, as far as it has a place already."""
    ends = [tie.end if tie.start == key else tie.start for tie in ties if key in (tie.start, tie.end)]
    return [places[end] for end in ends if end in places]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def _links(ties: Sequence[Tie], nodes: Mapping[str, Node], measures: Measures) -> Iterator[Link]:
    """Those that meet at a box stand beside each other there, in the order of their other ends, and cross less."""
    heights = {}
    for side in _Side:
        for key, node in nodes.items():
            met = [index for index, tie in enumerate(ties) if (tie.start, tie.end)[side] == key]
            met.sort(key=lambda index: nodes[(ties[index].end, ties[index].start)[side]].y)
            first = node.y + node.height / 2 - measures.port * (len(met) - 1) / 2
            heights.update({(side, index): first + measures.port * place for place, index in enumerate(met)})
    for index, tie in enumerate(ties):
        start, end = nodes[tie.start], nodes[tie.end]
        yield Link(tie, start.x + start.width, heights[_Side.START, index], end.x, heights[_Side.END, index])


class PartKind(enum.Enum):
    ENDPOINT = "endpoint"
    ANYONE = "anyone"
    TOPIC = "topic"
    CASE = "case"
    IGNORED = "ignored"
    GATEWAY = "gateway"
    CLIENTS = "clients"


@dataclass(frozen=True, slots=True)
class Part:
    """An endpoint, a topic, a payload case, a gateway or its clients, in a column of the map.

    `key` is unique in a map. `about` says in a few words what the name does not: an address, a type, a ttl.
    """

    key: str
    column: int
    kind: PartKind
    name: str
    about: str = ""


@dataclass(frozen=True, slots=True)
class Tie:
    """Messages go from one part to another, named by their keys.

    `route` and `label` are those of the metrics. A tie to a case is counted as
    `messages_received{route, source=label}`, for ANY the sum over all sources; one from a case as `datagrams_sent`
    or `messages_published`; a gateway's to its clients as `messages_sent`. `about` says under which conditions.
    """

    start: str
    end: str
    route: str
    label: str
    about: str = ""


def map_parts(table: RouteTable) -> tuple[list[Part], list[Tie]]:
    """Everything that the table names in a route or a gateway, each once in a column, in the order of the table."""
    parts: dict[str, Part] = {}
    ties: list[Tie] = []
    for route in table.routes:
        for part in (_case(route), *_sources(route, table), *_targets(route, table)):
            parts.setdefault(part.key, part)
        ties += _ties(route)
    for gateway in table.gateways.values():
        for part in _gateway_parts(gateway, table):
            parts.setdefault(part.key, part)
        ties += _gateway_ties(gateway, table)
    return list(parts.values()), ties


def _case(route: Route) -> Part:
    case = route.case.value
    if route.ignore is not None:
        return Part(f"case:{case}", 1, PartKind.IGNORED, case, f"ignored: {route.ignore}")
    words = []
    if route.ttl is not None:
        words.append(f"dropped when older than {duration(route.ttl.value)}")
    if route.deadman is not None:
        words.append(f"deadman after {duration(route.deadman.timeout.value)}")
    if route.collect is not None:
        words.append("collected to frames")
    return Part(f"case:{case}", 1, PartKind.CASE, case, ", ".join(words))


def _sources(route: Route, table: RouteTable) -> Iterator[Part]:
    if route.ignore is not None:
        return
    if route.is_outbound:
        for topic in route.topics:
            yield Part(f"from:{topic.topic.value}", 0, PartKind.TOPIC, topic.topic.value, topic.type.value)
        return
    for source in route.sources:
        if source.value == ANY:
            yield Part(f"from:@{ANY}", 0, PartKind.ANYONE, "any sender")
        else:
            yield _endpoint(table.endpoints[source.value], "from", 0)


def _targets(route: Route, table: RouteTable) -> Iterator[Part]:
    for destination in route.destinations:
        yield _endpoint(table.endpoints[destination.endpoint.value], "to", 2)
    for topic in () if route.is_outbound else route.topics:
        yield Part(f"to:{topic.topic.value}", 2, PartKind.TOPIC, topic.topic.value, topic.type.value)


def _endpoint(endpoint: Endpoint, side: str, column: int) -> Part:
    about = f"{endpoint.kind.value}, {endpoint.address.value}"
    return Part(f"{side}:@{endpoint.name}", column, PartKind.ENDPOINT, endpoint.name, about)


def _ties(route: Route) -> Iterator[Tie]:
    case = f"case:{route.case.value}"
    if route.ignore is not None:
        return
    if route.is_outbound:
        for topic in route.topics:
            yield Tie(f"from:{topic.topic.value}", case, route.name, topic.topic.value, _condition(topic))
    else:
        for source in (source.value for source in route.sources):
            yield Tie(f"from:@{source}", case, route.name, source)
    for destination in route.destinations:
        name = destination.endpoint.value
        yield Tie(case, f"to:@{name}", route.name, name, _condition(destination))
    for topic in () if route.is_outbound else route.topics:
        name = topic.topic.value
        yield Tie(case, f"to:{name}", route.name, name, _condition(topic))


def _condition(target: Destination | Topic) -> str:
    return ", ".join(" ".join(words.split()) for key, words in phrases(target).items() if key != "keep")


def _gateway_parts(gateway: Gateway, table: RouteTable) -> Iterator[Part]:
    yield Part(_key(gateway), 1, PartKind.GATEWAY, gateway.name, f"gateway, {gateway.transport.value.value}")
    included = ", ".join(pattern.text for pattern in gateway.include) or "all"
    excluded = ", ".join(pattern.text for pattern in gateway.exclude)
    about = f"{included} but {excluded}" if excluded else included
    yield Part(f"from:{_key(gateway)}", 0, PartKind.TOPIC, "ROS topics", about)
    place = gateway.address.value if gateway.address is not None else gateway.transport.value.value
    yield Part(f"to:{_key(gateway)}", 2, PartKind.CLIENTS, f"clients of {gateway.name}", str(place))
    for inbound in gateway.inbound:
        yield Part(f"clients:{_key(gateway)}", 0, PartKind.CLIENTS, f"clients of {gateway.name}", str(place))
        name = resolved(inbound.topic.topic.value, table.node)
        yield Part(f"to:{name}", 2, PartKind.TOPIC, name, inbound.topic.type.value)


def _gateway_ties(gateway: Gateway, table: RouteTable) -> Iterator[Tie]:
    key = _key(gateway)
    yield Tie(f"from:{key}", key, gateway.name, ROS)
    yield Tie(key, f"to:{key}", gateway.name, CLIENTS)
    if gateway.inbound:
        yield Tie(f"clients:{key}", key, gateway.name, CLIENTS)
    for inbound in gateway.inbound:
        name = resolved(inbound.topic.topic.value, table.node)
        yield Tie(key, f"to:{name}", gateway.name, name, _condition(inbound.topic))


def _key(gateway: Gateway) -> str:
    return f"gateway:{gateway.name}"

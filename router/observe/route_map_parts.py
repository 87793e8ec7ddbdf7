"""What there is to draw of a route table: the parts of its map, and what ties them together.

Knows the table, and by which labels the metrics count each tie; places nothing (see `route_map`).
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass

from router.compiler.metrics import CLIENTS
from router.compiler.topics import resolved
from router.table.model import ANY, ROS, Destination, Endpoint, Gateway, Route, RouteTable, Topic
from router.table.quantities import duration


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
        return Part(f"case:{case}", 1, PartKind.IGNORED, case, f"ignored: {route.ignore.value}")
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
    words = [f"when {' '.join(target.when.text.split())}"] if target.when is not None else []
    words += [f"at most {target.max_rate.value:g} Hz"] if target.max_rate is not None else []
    return ", ".join(words)


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

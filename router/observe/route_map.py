"""The map of a route table: sources, payload cases and targets, for the status page and `router graph`.

Sources are on the left, payload cases in the middle, targets on the right. Edges have the labels with which
metrics count their messages.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass

from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import CLIENTS
from router.compiler.topics import resolved
from router.errors import listed
from router.table.keys import phrases
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint
from router.table.model.gateways import Gateway
from router.table.model.routes import ANY, ROS, Route
from router.table.model.targets import Destination, Reply, Topic
from router.table.units import duration

COLUMNS = ("from", "payload case", "to")


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

    `key` is unique in a map. `about` adds a few words to the name: an address, a type, a ttl. Endpoints have an
    `address` and a `role` (their `kind`); clients of a gateway have an `address`. A payload case `is_guarded` by a ttl
    or a deadman.
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

    `route` and `label` are labels of metrics. An edge to a case is counted by `messages_received{route, source=label}`,
    summed over all sources for ANY; an edge from a case by `datagrams_sent` or `messages_published`; an edge from a
    gateway to its clients by `messages_sent`. `about` has the conditions.
    """

    start: str
    end: str
    route: str
    label: str
    about: str = ""


def nodes_and_edges(table: RouteTable) -> tuple[list[Node], list[Edge]]:
    """Return everything that routes and gateways name, once per column, in the order of the table."""
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


def deadman_edges(program: CompiledTable) -> Iterator[Edge]:
    """Yield edges for what deadmen send in place of commands, counted by `deadman_datagrams_sent{route,
    destination=label}`.
    """
    for route in program.table.routes:
        if route.deadman is not None:
            about = f"the deadman sends {listed([each.case.value for each in route.deadman.payloads])}"
            for name in (to.value for to in route.deadman.to):
                yield Edge(f"case:{route.case.value}", f"to:@{name}", route.name, name, about)
    for gateway in program.gateways:
        for topic, inbound in gateway.inbound.items():
            if inbound.deadman is not None:
                about = "the deadman publishes"
                yield Edge(_key(gateway.settings), f"to:{topic}", inbound.deadman.route, topic, about)


def _case(route: Route) -> Node:
    case = route.case.value
    if route.ignore is not None:
        return Node(f"case:{case}", 1, NodeKind.IGNORED, case, f"ignored: {route.ignore}")
    words = []
    if route.ttl is not None:
        words.append(f"dropped when older than {duration(route.ttl.value)}")
    if route.deadman is not None:
        words.append(f"deadman after {duration(route.deadman.timeout.value)}")
    if route.order is not None:
        words.append(f"in the order of {route.order.text}")
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
            yield endpoint_node(table.endpoints[source.value], "from", 0)


def _targets(route: Route, table: RouteTable) -> Iterator[Node]:
    for destination in route.destinations:
        yield endpoint_node(table.endpoints[destination.endpoint.value], "to", 2)
    for source in route.sources if route.reply is not None else ():
        yield endpoint_node(table.endpoints[source.value], "to", 2)
    for topic in route.topics:
        yield Node(f"to:{topic.topic.value}", 2, NodeKind.TOPIC, topic.topic.value, topic.type_name)


def endpoint_node(endpoint: Endpoint, side: str, column: int) -> Node:
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
    if (reply := route.reply) is not None:
        about = ", ".join(filter(None, (f"reply {reply.case.value}", _condition(reply))))
        for name in (source.value for source in route.sources):
            yield Edge(case, f"to:@{name}", route.name, name, about)
    for topic in route.topics:
        name = topic.topic.value
        yield Edge(case, f"to:{name}", route.name, name, _condition(topic))


def _condition(target: Destination | Reply | Topic) -> str:
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

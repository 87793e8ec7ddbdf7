"""What the demo's processes say, and what must arrive for it to pass, read from the route table."""

from __future__ import annotations

from pathlib import Path

from router.compiler.check import check_table
from router.compiler.topics import resolved
from router.errors import TableError
from router.table.addresses import Address
from router.table.model import EndpointKind, GatewayFormat, Route, RouteTable, Transport

COMMANDED, LOST, FOUND = 3.0, 5.0, 8.0
"""Seconds by the simulator's clock: until when the rover's software commands the boards, and when the link to all
basestations is lost and found again. A command of the software after LOST would disarm the operator's deadmen."""


def checked_table(path: Path) -> RouteTable:
    """The table with the types of all topics. Raises TableError if it has errors."""
    checked = check_table(path)
    if checked.table is None or checked.has_errors:
        raise TableError(checked.diagnostics)
    return checked.table


def active_routes(table: RouteTable) -> list[Route]:
    """All that carry something."""
    return [route for route in table.routes if route.ignore is None]


def inbound_topics(table: RouteTable) -> dict[str, str]:
    """ROS type by topic of what the router publishes."""
    return _topics([route for route in active_routes(table) if not route.is_outbound])


def outbound_topics(table: RouteTable) -> dict[str, str]:
    """ROS type by topic of what the router subscribes to."""
    return _topics([route for route in active_routes(table) if route.is_outbound])


def command_topics(table: RouteTable) -> set[str]:
    """Those of outbound topics that command a board. While they do, no deadman of the operator's commands trips."""
    boards = {name for name, endpoint in table.endpoints.items() if endpoint.kind is EndpointKind.BOARD}
    return {
        topic.topic.value
        for route in active_routes(table)
        if route.is_outbound and any(destination.endpoint.value in boards for destination in route.destinations)
        for topic in route.source_topics
    }


def _topics(routes: list[Route]) -> dict[str, str]:
    return {topic.topic.value: topic.type_name for route in routes for topic in route.all_topics}


def page_of(table: RouteTable) -> Address | None:
    """Where the table has a page for browsers."""
    for gateway in table.gateways.values():
        is_for_browsers = gateway.transport.value is Transport.WEBSOCKET and gateway.format is GatewayFormat.JSON
        if is_for_browsers and gateway.address is not None:
            return gateway.address.value
    return None


def shown_topics(table: RouteTable) -> set[str]:
    """What the page has to show: absolute names of what the router publishes."""
    return {resolved(topic, table.node) for topic in inbound_topics(table)}


def expected_arrivals(table: RouteTable) -> set[tuple[str, str]]:
    """Destination endpoint and payload case of everything that is to arrive at the simulator."""
    return {
        (destination.endpoint.value, route.case.value)
        for route in active_routes(table)
        for destination in route.destinations
    }


def basestations(table: RouteTable) -> list[str]:
    """The endpoints whose link is lost for a while: those that send something."""
    senders = {source.value for route in active_routes(table) for source in route.sources}
    kinds = {name: endpoint.kind for name, endpoint in table.endpoints.items()}
    return [name for name, kind in kinds.items() if kind is EndpointKind.BASESTATION and name in senders]


def halted_boards(table: RouteTable) -> set[str]:
    """To whom deadmen speak while the link is lost."""
    silent = basestations(table)
    return {
        to.value
        for route in active_routes(table)
        if route.deadman is not None and any(source.value in silent for source in route.sources)
        for to in route.deadman.to
    }

"""What must arrive for the demo to pass, according to the route table."""

from __future__ import annotations

from pathlib import Path

from router.compiler.check import check_table
from router.compiler.topics import resolved
from router.errors import TableError
from router.table.addresses import Address
from router.table.model import RouteTable
from router.table.model.endpoints import EndpointKind
from router.table.model.gateways import GatewayFormat, Transport
from router.table.model.routes import Route

COMMANDED, LOST, FOUND = 3.0, 5.0, 8.0
"""Seconds on the simulator's clock: the end of the software's commands to boards, then the loss and the return of the
link to all basestations. A command of the software after LOST would disarm the operator's deadmen."""


def checked_table(path: Path) -> RouteTable:
    """Read the table, with the types of all topics. Raises TableError if it has errors."""
    checked = check_table(path)
    if checked.table is None or checked.has_errors:
        raise TableError(checked.diagnostics)
    return checked.table


def active_routes(table: RouteTable) -> list[Route]:
    """Routes that the table does not ignore."""
    return [route for route in table.routes if route.ignore is None]


def inbound_topics(table: RouteTable) -> dict[str, str]:
    """ROS types of the topics that the router publishes, by topic."""
    return _topics([route for route in active_routes(table) if not route.is_outbound])


def outbound_topics(table: RouteTable) -> dict[str, str]:
    """ROS types of the topics that the router subscribes to, by topic."""
    return _topics([route for route in active_routes(table) if route.is_outbound])


def command_topics(table: RouteTable) -> set[str]:
    """Outbound topics with commands to a board. These commands keep the operator's deadmen disarmed."""
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
    """Address of the table's page for browsers; None without one."""
    for gateway in table.gateways.values():
        is_for_browsers = gateway.transport.value is Transport.WEBSOCKET and gateway.format is GatewayFormat.JSON
        if is_for_browsers and gateway.address is not None:
            return gateway.address.value
    return None


def shown_topics(table: RouteTable) -> set[str]:
    """Topics that the page must show: absolute names of what the router publishes."""
    return {resolved(topic, table.node) for topic in inbound_topics(table)}


def expected_arrivals(table: RouteTable) -> set[tuple[str, str]]:
    """Pairs of destination endpoint and payload case that must arrive at the simulator."""
    return {
        (destination.endpoint.value, route.case.value)
        for route in active_routes(table)
        for destination in route.destinations
    }


def basestations(table: RouteTable) -> list[str]:
    """Basestations that send something: the demo cuts their link for a while."""
    senders = {source.value for route in active_routes(table) for source in route.sources}
    kinds = {name: endpoint.kind for name, endpoint in table.endpoints.items()}
    return [name for name, kind in kinds.items() if kind is EndpointKind.BASESTATION and name in senders]


def halted_boards(table: RouteTable) -> set[str]:
    """Boards to which deadmen send while the link is lost."""
    silent = basestations(table)
    return {
        to.value
        for route in active_routes(table)
        if route.deadman is not None and any(source.value in silent for source in route.sources)
        for to in route.deadman.to
    }

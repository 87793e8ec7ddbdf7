"""What must arrive for the demo to pass, read from the route table."""

from __future__ import annotations

from router.table.model import Route, RouteTable


def udp_routes(table: RouteTable) -> list[Route]:
    """The routes that carry what the simulator sends."""
    return [route for route in table.routes if route.sources and not route.is_outbound]


def expected_topics(table: RouteTable) -> dict[str, str]:
    """ROS type by topic, as the table names both."""
    return {topic.topic.value: topic.type.value for route in udp_routes(table) for topic in route.topics}


def expected_arrivals(table: RouteTable) -> set[tuple[str, str]]:
    """Destination endpoint and payload case of everything that is to come back to the simulator."""
    return {
        (destination.endpoint.value, route.case.value)
        for route in udp_routes(table)
        for destination in route.destinations
    }

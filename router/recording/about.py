"""The metadata of a recording: why it was written, and what the table says about its routes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from router.table.model import RouteTable

LONGEST_NAMES = 60
"""Maximum characters of the names of deadmen in a file's name."""


class RecordedRoute(NamedTuple):
    """A route of the table that ran: its payload case, the endpoints or ROS topics that it accepts messages from.

    `timeout_ms` and `brakes`: the deadman's timeout, 0 without one, and the endpoints that it sends to.
    """

    case: str
    sources: Sequence[str]
    is_from_ros: bool
    timeout_ms: float
    brakes: Sequence[str]


def about(table: RouteTable, reason: str, tripped: Sequence[str] = ()) -> dict[str, str]:
    """Return the metadata of a file. `tripped` are the deadmen that caused it, the first one first."""
    routes = {
        route.name: RecordedRoute(
            route.case.value,
            [*(source.value for source in route.sources), *(topic.topic.value for topic in route.source_topics)],
            route.is_outbound,
            route.deadman.timeout.value / 1e6 if route.deadman else 0.0,
            [to.value for to in route.deadman.to] if route.deadman else [],
        )._asdict()
        for route in table.routes
        if route.ignore is None
    }
    metadata = {"reason": reason, "table": table.path.name, "routes": json.dumps(routes)}
    if len(table.envelopes) > 1:
        metadata["envelopes"] = json.dumps(table.envelope_names)
    return {**metadata, "tripped": json.dumps(tripped)} if tripped else metadata


def routes_of(metadata: Mapping[str, str]) -> dict[str, RecordedRoute]:
    """Return the routes in the metadata, which old recordings do not have."""
    routes: dict[str, dict[str, Any]] = json.loads(metadata.get("routes", "{}"))
    return {name: RecordedRoute(**values) for name, values in routes.items()}


def envelopes_of(metadata: Mapping[str, str]) -> Sequence[Mapping[str, str]]:
    """Return the names of the envelopes of listeners and of endpoints, empty for a table with one."""
    names: Sequence[Mapping[str, str]] = json.loads(metadata.get("envelopes", "[{}, {}]"))
    return names


def tripped_in(metadata: Mapping[str, str]) -> list[str]:
    """Return the deadmen that caused the recording, the first one first."""
    tripped: list[str] = json.loads(metadata.get("tripped", "[]"))
    return tripped


def reason_of(tripped: Sequence[str]) -> str:
    """Return the reason of a file for these deadmen, for its name: the first ones that fit, and how many follow."""
    shown = [tripped[0][:LONGEST_NAMES]]
    for name in tripped[1:]:
        if len("-".join((*shown, name))) > LONGEST_NAMES:
            break
        shown.append(name)
    more = [f"and-{left}-more"] if (left := len(tripped) - len(shown)) else []
    return "-".join(("deadman", *shown, *more))

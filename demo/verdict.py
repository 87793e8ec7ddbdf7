"""Judges from the reports of ROS listener, simulator and metrics whether the demo worked."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from demo.expected import (
    FOUND,
    LOST,
    basestations,
    expected_arrivals,
    halted_boards,
    inbound_topics,
    outbound_topics,
    shown_topics,
)
from demo.page import Shown
from demo.recorded import Recorded
from router.table.model import RouteTable
from router.tools.top import View
from router.tools.top_view import reasons_text

WANTED_DROPS = frozenset({"rate_limited", "stale"})
"""Losses that a table intends, by `max_rate` and `ttl`."""

Said = Mapping[str, Any]
"""The newest JSON line of a child process."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check, and its text."""

    ok: bool
    text: str


def judge(
    table: RouteTable,
    heard: Said,
    simulated: Said,
    view: View | None,
    shown: Shown | None = None,
    recorded: Recorded | None = None,
) -> list[Finding]:
    """Check everything. `heard` and `simulated` are the last reports of ROS listener and simulator.

    `view` is the last scrape, `shown` what the table's page showed (None without a page), `recorded` the recording of
    the lost link.
    """
    return [
        _topics(table, heard),
        _arrivals(table, simulated),
        *_frames(table, simulated),
        _deadman(table, simulated),
        *([_recording(recorded)] if table.record and table.record.last else []),
        *([] if shown is None else [_page(table, shown)]),
        _losses(table, view),
    ]


def topic_count(heard: Said, topic: str) -> int:
    """Messages that the ROS subscriber has received on a topic."""
    return int(heard.get("topics", {}).get(topic, {}).get("count", 0))


def arrival_count(simulated: Said, endpoint: str, case: str) -> int:
    """Datagrams of a payload case that arrived at a simulated endpoint."""
    return int(simulated.get("received", {}).get(endpoint, {}).get(case, {}).get("count", 0))


def _topics(table: RouteTable, heard: Said) -> Finding:
    counts = {topic: topic_count(heard, topic) for topic in inbound_topics(table)}
    silent = [topic for topic, count in counts.items() if not count]
    if silent:
        return Finding(False, f"nothing arrived on {len(silent)} of {len(counts)} ROS topics: {', '.join(silent)}")
    messages = sum(counts.values())
    return Finding(True, f"messages on all {len(counts)} ROS topics: {messages}, counted by a separate rclpy node")


def _arrivals(table: RouteTable, simulated: Said) -> Finding:
    counts = {pair: arrival_count(simulated, *pair) for pair in sorted(expected_arrivals(table))}
    missing = [f"{case} at {endpoint}" for (endpoint, case), count in counts.items() if not count]
    undecodable = sum(simulated.get("undecodable", {}).values())
    if missing:
        return Finding(False, f"{len(missing)} of {len(counts)} payload cases never arrived: {', '.join(missing)}")
    if undecodable:
        return Finding(False, f"{undecodable} datagrams arrived undecodable")
    topics, datagrams = len(outbound_topics(table)), sum(counts.values())
    words = f"all {len(counts)} payload cases at boards and basestation, including those from {topics} ROS topics"
    return Finding(True, f"{words}: {datagrams} datagrams")


def _frames(table: RouteTable, simulated: Said) -> Iterator[Finding]:
    """Check that lists that were split into datagrams are reassembled."""
    for route in table.routes:
        for destination in route.destinations if route.for_each else ():
            case, endpoint = route.case.value, destination.endpoint.value
            frames = simulated.get("frames", {}).get(endpoint, {}).get(case, {"complete": 0})
            yield Finding(frames["complete"] > 0, f"{endpoint} reassembled {frames['complete']} frames of {case}")


def _deadman(table: RouteTable, simulated: Said) -> Finding:
    """Check that each board was halted while the link was lost, and obeyed commands again afterwards."""
    boards = sorted(halted_boards(table))
    if not boards:
        return Finding(False, "no route from a basestation has a deadman")
    halted = {board: _change(simulated, board, "halted", LOST, FOUND) for board in boards}
    released = {board: _change(simulated, board, "obeying", FOUND, math.inf) for board in boards}
    missing = [f"{board} was not halted" for board, at in halted.items() if at is None]
    missing += [f"{board} did not obey again" for board, at in released.items() if at is None]
    cut = f"the link to {' and '.join(basestations(table))} was cut"
    if missing:
        return Finding(False, f"{cut} from {LOST:.0f} to {FOUND:.0f} s, and {', '.join(missing)}")
    told = ", ".join(f"{board} after {at - LOST:.2f} s" for board, at in halted.items() if at is not None)
    return Finding(True, f"{cut} for {FOUND - LOST:.0f} s: deadmen halted {told}; boards obeyed again afterwards")


def _change(simulated: Said, board: str, state: str, start: float, end: float) -> float | None:
    """The time at which a board first entered a state between `start` and `end`."""
    changes = (c for c in simulated.get("changes", ()) if (c["board"], c["state"]) == (board, state))
    return next((float(change["at"]) for change in changes if start <= change["at"] < end), None)


def _recording(recorded: Recorded | None) -> Finding:
    """Check that the datagrams before the halt were saved."""
    if recorded is None or not recorded.datagrams:
        return Finding(False, "the datagrams before the halt were not recorded")
    return Finding(True, f"the {recorded.datagrams} datagrams before the halt are in {recorded.path}")


def _page(table: RouteTable, shown: Shown) -> Finding:
    """Check that a client that opens the page late gets everything at once."""
    wanted = shown_topics(table)
    if not shown.has_page:
        return Finding(False, "the dashboard's page or websocket cannot be reached")
    if missing := sorted(wanted - shown.topics):
        return Finding(False, f"the dashboard's page got nothing for {', '.join(missing)}")
    if shown.early:
        return Finding(False, f"the dashboard's page got data before its schema: {', '.join(sorted(shown.early))}")
    return Finding(True, f"the dashboard's page got all {len(wanted)} topics, each with its schema first")


def _losses(table: RouteTable, view: View | None) -> Finding:
    if view is None:
        return Finding(False, "the router's metrics could not be read")
    lost, wanted = Counter(view.rejected), Counter[str]()
    for row in view.routes:
        for reason, count in row.dropped.items():
            (wanted if reason in WANTED_DROPS else lost)[reason] += count
    if view.kernel_drops:
        lost["kernel_drops"] = view.kernel_drops
    if lost:
        return Finding(False, f"the router lost messages: {reasons_text(lost)}")
    received = sum(row.received for row in view.routes if row.route not in table.gateways)
    withheld = f"; dropped as the table says: {reasons_text(wanted)}" if wanted else ""
    return Finding(True, f"the router accepted {received} messages and lost none{withheld}")

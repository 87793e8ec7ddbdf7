"""Whether the demo worked, from what the ROS subscriber, the simulator and the metrics say, and in which words."""

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
from router.tools.top_table import reasons_text

WANTED_DROPS = frozenset({"rate_limited", "stale"})
"""Losses that a table asks for, by `max_rate` and `ttl`."""


Said = Mapping[str, Any]
"""The newest JSON line of a child process."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that must be so: whether it is, and in words."""

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
    """`heard` and `simulated` are the last words of the ROS listener and the simulator, `view` the last scrape.

    `shown` is what the table's page had to show, None where it has none; `recorded` what was saved of the lost link.
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
    words = f"all {len(counts)} payload cases at boards and basestation, those from {topics} ROS topics among them"
    return Finding(True, f"{words}: {datagrams} datagrams")


def _frames(table: RouteTable, simulated: Said) -> Iterator[Finding]:
    """What is split into one datagram for each element is put together again."""
    for route in table.routes:
        for destination in route.destinations if route.for_each else ():
            case, endpoint = route.case.value, destination.endpoint.value
            frames = simulated.get("frames", {}).get(endpoint, {}).get(case, {"complete": 0})
            yield Finding(frames["complete"] > 0, f"{endpoint} put {frames['complete']} frames of {case} together")


def _deadman(table: RouteTable, simulated: Said) -> Finding:
    """Whether each board was told to halt while the link was lost, and obeyed again when it was found."""
    boards = sorted(halted_boards(table))
    if not boards:
        return Finding(False, "no deadman guards what a basestation commands")
    halted = {board: _change(simulated, board, "halted", LOST, FOUND) for board in boards}
    released = {board: _change(simulated, board, "obeying", FOUND, math.inf) for board in boards}
    missing = [f"{board} was not halted" for board, at in halted.items() if at is None]
    missing += [f"{board} did not obey again" for board, at in released.items() if at is None]
    cut = f"the link to {' and '.join(basestations(table))} was cut"
    if missing:
        return Finding(False, f"{cut} from {LOST:.0f} to {FOUND:.0f} s, and {', '.join(missing)}")
    told = ", ".join(f"{board} after {at - LOST:.2f} s" for board, at in halted.items() if at is not None)
    return Finding(True, f"{cut} for {FOUND - LOST:.0f} s: halted {told}; obeyed again when it was back")


def _change(simulated: Said, board: str, state: str, start: float, end: float) -> float | None:
    """When a board first came into a state within these seconds."""
    changes = (c for c in simulated.get("changes", ()) if (c["board"], c["state"]) == (board, state))
    return next((float(change["at"]) for change in changes if start <= change["at"] < end), None)


def _recording(recorded: Recorded | None) -> Finding:
    """Whether there is a file of what came before that."""
    if recorded is None or not recorded.datagrams:
        return Finding(False, "what came before the boards were halted was not recorded")
    return Finding(True, f"the {recorded.datagrams} datagrams before that are in {recorded.path}")


def _page(table: RouteTable, shown: Shown) -> Finding:
    """Whether somebody who opens the page late gets everything at once."""
    wanted = shown_topics(table)
    if not shown.has_page:
        return Finding(False, "the dashboard's page or websocket cannot be reached")
    if missing := sorted(wanted - shown.topics):
        return Finding(False, f"the dashboard's page got nothing of {', '.join(missing)}")
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
    withheld = f", withheld {reasons_text(wanted)} as the table asks" if wanted else ""
    return Finding(True, f"the router took {received} messages and lost none{withheld}")

"""Whether the demo worked, from what the ROS subscriber, the simulator and the metrics say, and in which words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from demo.expected import expected_arrivals, expected_topics
from router.table.model import RouteTable
from router.tools.live import View
from router.tools.live_view import reasons_text

WANTED_DROPS = frozenset({"rate_limited"})
"""Losses that a table asks for by `max_rate`."""


Said = Mapping[str, Any]
"""The newest JSON line of a child process."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that must be so: whether it is, and in words."""

    ok: bool
    text: str


def judge(table: RouteTable, heard: Said, simulated: Said, view: View | None) -> list[Finding]:
    """`heard` and `simulated` are the last words of the ROS listener and the simulator, `view` the last scrape."""
    return [_topics(table, heard), _arrivals(table, simulated), _losses(view)]


def topic_count(heard: Said, topic: str) -> int:
    """Messages that the ROS subscriber has received on a topic."""
    return int(heard.get("topics", {}).get(topic, {}).get("count", 0))


def arrival_count(simulated: Said, endpoint: str, case: str) -> int:
    """Datagrams of a payload case that came back to a simulated endpoint."""
    return int(simulated.get("received", {}).get(endpoint, {}).get(case, {}).get("count", 0))


def _topics(table: RouteTable, heard: Said) -> Finding:
    counts = {topic: topic_count(heard, topic) for topic in expected_topics(table)}
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
        return Finding(False, f"{len(missing)} of {len(counts)} forwards never came: {', '.join(missing)}")
    if undecodable:
        return Finding(False, f"{undecodable} datagrams came back undecodable")
    names = {endpoint for endpoint, _ in counts}
    return Finding(True, f"datagrams came back at all {len(names)} destinations: {sum(counts.values())}")


def _losses(view: View | None) -> Finding:
    if view is None:
        return Finding(False, "the router's metrics could not be read")
    lost = dict(view.rejected)
    for row in view.routes:
        for reason, count in row.dropped.items():
            if reason not in WANTED_DROPS:
                lost[reason] = lost.get(reason, 0) + count
    if view.kernel_drops:
        lost["kernel_drops"] = view.kernel_drops
    if lost:
        return Finding(False, f"the router lost messages: {reasons_text(lost)}")
    return Finding(True, f"the router took {view.received} datagrams and lost none")

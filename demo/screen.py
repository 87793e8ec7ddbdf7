"""What the demo shows while it runs: a live table in a terminal, otherwise a line every few seconds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from demo.expected import active_routes
from demo.verdict import Said, arrival_count, topic_count
from router.table.model import RouteTable
from router.tools.top import Order, RouteRow, View
from router.tools.top_view import RouteTable as Routes
from router.tools.top_view import summary_line

LINE_INTERVAL = 3.0
"""Seconds between two lines without a terminal."""

CHANGES_SHOWN = 3
"""How many of the newest changes of boards' states are shown."""


class Screen(Protocol):
    def show(self, view: View, heard: Said, simulated: Said) -> None:
        """Show the state. `heard` and `simulated` are the newest reports of listener and simulator."""


@contextmanager
def open_screen(console: Console, table: RouteTable, duration: float) -> Iterator[Screen]:
    if not console.is_terminal:
        yield _Lines(console)
        return
    with Live(console=console, screen=True, auto_refresh=False) as live:
        yield _Terminal(console, live, table, duration)


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._next = LINE_INTERVAL
        self._told = 0

    def show(self, view: View, heard: Said, simulated: Said) -> None:
        for change in _changes(simulated)[self._told :]:
            self._print(change)
            self._told += 1
        seconds = simulated["seconds"]
        if seconds < self._next:
            return
        self._next += LINE_INTERVAL
        ros = sum(topic["count"] for topic in heard.get("topics", {}).values())
        arrived = sum(case["count"] for cases in simulated["received"].values() for case in cases.values())
        line = f"{seconds:.0f} s: {summary_line(view)}; received on ROS {ros}, at boards and basestation {arrived}"
        self._print(line)

    def _print(self, line: str) -> None:
        self._console.print(line, highlight=False, soft_wrap=True)


def _changes(simulated: Said) -> list[str]:
    """Changes of the boards' states as text, the newest last."""
    return [f"{change['at']:.1f} s: {change['board']} {change['text']}" for change in simulated["changes"]]


class _Terminal:
    def __init__(self, console: Console, live: Live, table: RouteTable, duration: float) -> None:
        self._console, self._live, self._duration = console, live, duration
        self._routes = {route.name: route for route in active_routes(table)}

    def show(self, view: View, heard: Said, simulated: Said) -> None:
        def on_ros(row: RouteRow) -> Text:
            """The count of the route's slowest topic, because each topic must get every message."""
            route = self._routes.get(row.route)  # None for a gateway
            topics = () if route is None else route.topics
            return _count([topic_count(heard, topic.topic.value) for topic in topics])

        def on_udp(row: RouteRow) -> Text:
            route = self._routes.get(row.route)
            if route is None:
                return _count([])
            ends = [destination.endpoint.value for destination in route.destinations]
            return _count([arrival_count(simulated, endpoint, route.case.value) for endpoint in ends])

        title = Text(f"router demo, {simulated['seconds']:.0f} of {self._duration:.0f} s", style="bold")
        title.append(f"  {summary_line(view)}", style="not bold")
        changes = [Text(change, style="yellow", no_wrap=True) for change in _changes(simulated)[-CHANGES_SHOWN:]]
        legend = Text(style="dim").append("destinations", style="cyan").append(", ").append("ROS topics", style="green")
        legend.append("; on ROS, on UDP: messages that arrived there")
        room = self._console.height - 3 - len(changes)
        table = Routes(view, Order.DROPS, room, columns={"on ROS": on_ros, "on UDP": on_udp})
        self._live.update(Group(title, table, *changes, legend), refresh=True)


def _count(counts: list[int]) -> Text:
    """Messages that arrived at the route's slowest target; empty if there is no target."""
    if not counts:
        return Text("")
    return Text(str(min(counts)), style="" if min(counts) else "red")

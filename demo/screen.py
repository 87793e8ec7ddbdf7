"""What the demo shows while it runs: in place on a terminal, a line now and then elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from demo.expected import udp_routes
from demo.verdict import Said, arrival_count, topic_count
from router.table.model import RouteTable
from router.tools.live import RouteRow, View
from router.tools.live_view import route_table, summary_line

LINE_INTERVAL = 3.0
"""Seconds between two lines where there is no terminal."""


class Screen(Protocol):
    def show(self, seconds: float, view: View, heard: Said, simulated: Said) -> None:
        """`seconds` since the simulator started; the newest words of listener and simulator."""


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

    def show(self, seconds: float, view: View, heard: Said, simulated: Said) -> None:
        if seconds < self._next:
            return
        self._next += LINE_INTERVAL
        ros = sum(topic["count"] for topic in heard.get("topics", {}).values())
        back = sum(case["count"] for cases in simulated.get("received", {}).values() for case in cases.values())
        line = f"{seconds:4.0f} s  {summary_line(view)}; heard on ROS {ros}, back at the simulator {back}"
        self._console.print(line, highlight=False, soft_wrap=True)


class _Terminal:
    def __init__(self, console: Console, live: Live, table: RouteTable, duration: float) -> None:
        self._console, self._live, self._duration = console, live, duration
        self._routes = {route.case.value: route for route in udp_routes(table)}

    def show(self, seconds: float, view: View, heard: Said, simulated: Said) -> None:
        def on_ros(row: RouteRow) -> Text:
            """The slowest topic of the route counts: each shall get every message."""
            return _count([topic_count(heard, t.topic.value) for t in self._routes[row.route].topics])

        def came_back(row: RouteRow) -> Text:
            ends = [d.endpoint.value for d in self._routes[row.route].destinations]
            return _count([arrival_count(simulated, endpoint, row.route) for endpoint in ends])

        shown = View(
            tuple(row for row in view.routes if row.route in self._routes),
            view.received,
            view.rate,
            view.rejected,
            view.kernel_drops,
        )
        title = Text(f"router demo, {seconds:.0f} of {self._duration:.0f} s", style="bold")
        title.append(f"  {summary_line(view)}", style="not bold")
        legend = Text(style="dim").append("destinations", style="cyan").append(", ").append("ROS topics", style="green")
        legend.append("; on ROS, back: counted by a ROS node, by the simulator")
        table = route_table(shown, self._console.height - 3, {"on ROS": on_ros, "back": came_back})
        self._live.update(Group(title, table, legend), refresh=True)


def _count(counts: list[int]) -> Text:
    """Arrived messages of a route's least served target; nothing where the table names no target."""
    if not counts:
        return Text("")
    return Text(str(min(counts)), style="" if min(counts) else "red")

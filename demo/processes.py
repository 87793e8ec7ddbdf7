"""The demo's four processes: starts, watches and ends them in order, and judges their output."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from demo.children import Child
from demo.expected import COMMANDED, FOUND, LOST, basestations, page_of, shown_topics
from demo.page import Shown, look
from demo.places import free_ros_domain
from demo.recorded import first_of, recordings
from demo.screen import open_screen
from demo.verdict import Finding, judge
from router.errors import RouterError, TransportError
from router.table.model import RouteTable
from router.tools.running_router import health, metrics, url_of
from router.tools.top import View, Window, view

TABLE = Path("routes/sim.yaml")
DURATION = 12.0
START_PATIENCE = 30.0
"""Seconds to wait for a process to be up; a cold start reads a lot from disk."""

MATCHING = 0.5
"""Seconds from when the ROS nodes have discovered the router until the router has discovered them."""

REFRESH = 0.5
DRAINING = 0.5
"""Seconds after the talker's last message, for the router to send its last datagrams."""

SETTLING = 1.0
"""Seconds after the last datagram was sent, for the listener's last report."""


class DemoError(RouterError):
    """The demo cannot continue; the message gives the reason, for a first-time user."""


class Demo:
    """The four processes and their output. The simulator starts last, and its clock is the demo's clock."""

    def __init__(self, table: RouteTable) -> None:
        if table.http is None:
            raise DemoError(f"{TABLE} has no `http` address, from which the demo reads the metrics")
        self._url = url_of(table)
        self._table = table
        self._env = os.environ | {
            "ROS_DOMAIN_ID": str(free_ros_domain()),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONUNBUFFERED": "1",
        }
        self._running: list[Child] = []

    def _start(self, name: str, *module: str) -> Child:
        child = Child(name, self._env, *module)
        self._running.append(child)
        return child

    def _finish(self, child: Child) -> None:
        self._running.remove(child)
        child.end()
        _check_exit(child, expected=0)

    def run(self, console: Console) -> list[Finding]:
        before = recordings(self._table)
        listener = self._start("listener", "demo.ros_listener", str(TABLE))
        self._start("router", "router", "run", str(TABLE))
        talker = self._start("talker", "demo.ros_talker", str(TABLE))
        self._wait_until_up(listener, talker)
        cut_off = [word for name in basestations(self._table) for word in ("--silent", f"{name}:{LOST}-{FOUND}")]
        simulator = self._start("simulator", "router", "sim", "-t", str(TABLE), "--json", *cut_off)
        self._wait_until(lambda: bool(simulator.latest), "the simulator did not start")
        talker.tell(str(time.monotonic() - simulator.latest["seconds"] + COMMANDED))
        window = Window()
        with open_screen(console, self._table, DURATION) as screen:
            while simulator.latest["seconds"] < DURATION:
                time.sleep(REFRESH)
                screen.show(self._look(window), listener.latest, simulator.latest)
        shown = self._look_at_page()
        self._finish(talker)
        time.sleep(DRAINING)
        self._finish(simulator)
        time.sleep(SETTLING)
        recorded = first_of(recordings(self._table) - before)
        return judge(self._table, listener.latest, simulator.latest, self._look(window), shown, recorded)

    def _look_at_page(self) -> Shown | None:
        """Return what the page shows; None if the table has no page."""
        address = page_of(self._table)
        return look(address, shown_topics(self._table)) if address else None

    def _wait_until_up(self, listener: Child, talker: Child) -> None:
        """Wait until the ROS nodes have discovered the router's topics: before that, the router publishes nothing."""
        self._wait_until(
            lambda: bool(listener.latest) and all(topic["publishers"] for topic in listener.latest["topics"].values()),
            "router and ROS listener did not discover each other",
        )
        self._wait_until(lambda: bool(talker.latest), "router and ROS talker did not discover each other")
        time.sleep(MATCHING)

    def _wait_until(self, holds: Callable[[], bool], complaint: str) -> None:
        deadline = time.monotonic() + START_PATIENCE
        while not holds():
            if time.monotonic() > deadline:
                raise DemoError(f"{complaint} within {START_PATIENCE:.0f} s")
            self._check()
            time.sleep(0.1)

    def _look(self, window: Window) -> View:
        self._check()
        try:
            window.add(metrics(self._url))
            return view(*window.ends, health(self._url).problems)
        except TransportError:
            self._check()  # if the router has ended, its own message is better than a refused connection
            raise

    def _check(self) -> None:
        """Raises DemoError if a process has ended."""
        for child in self._running:
            _check_exit(child, expected=None)

    def end(self) -> None:
        """Send SIGTERM to all processes, then wait for each."""
        for child in self._running:
            child.ask_to_end()
        for child in self._running:
            child.end()


def _check_exit(child: Child, expected: int | None) -> None:
    if child.exit_code != expected:
        raise DemoError(f"the {child.name} ended with exit code {child.exit_code}:\n{child.last_words()}")

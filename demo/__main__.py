"""`python -m demo`: simulated rover, router and real ROS nodes for some seconds; exit 0 when everything arrived.

In the middle the basestation is cut off, and a deadman has to halt the rover.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.table import Table
from rich.text import Text

from demo.children import Child
from demo.expected import FOUND, LOST, SILENT
from demo.places import free_ros_domain, taken_places
from demo.screen import open_screen
from demo.verdict import Finding, judge
from router.errors import RouterError, TransportError
from router.table.model import Address, RouteTable
from router.tools.live import Snapshot, Window, parse_metrics, scrape
from router.tools.wire import read_table

ROOT = Path(__file__).parent.parent
TABLE = Path("routes/sim.yaml")
DURATION = 12.0
START_PATIENCE = 30.0
"""Seconds within which a process must be up; a cold start reads a lot from disk."""

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
MATCHING = 0.5
"""Seconds after the listener has found the router until the router has found the listener."""

REFRESH = 0.5
DRAINING = 0.5
"""Seconds after the talker's last message in which boards and basestation may still be sent something."""

SETTLING = 1.0
"""Seconds after the last datagram was sent, for the listener's last report."""

SUCCESS = "It works: boards, basestation and real ROS 2 heard each other, and a lost link stopped the rover."
NEXT_STEPS = f"""\
Where to look next:
  routes/rover.yaml                      what goes where
  .venv/bin/router validate routes/      what is wrong with it, before driving
  .venv/bin/router explain imu_info      what becomes of one message
  .venv/bin/router run {TABLE}   all this by hand; in another terminal:
  .venv/bin/router sim"""


class DemoError(RouterError):
    """The demo cannot go on; the message says why, for a person who has just arrived."""


class Demo:
    """The four processes and what they say. Router and ROS listener start first, the others when those are up."""

    def __init__(self, table: RouteTable) -> None:
        if table.metrics is None:
            raise DemoError(f"{TABLE} has no metrics address, and the demo reads its rates there")
        self._metrics: Address = table.metrics.value
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
        listener = self._start("listener", "demo.ros_listener", str(TABLE))
        self._start("router", "router", "run", str(TABLE))
        self._wait_until_up(listener)
        cut_off = f"{SILENT}:{LOST}-{FOUND}"
        simulator = self._start("simulator", "router", "sim", str(TABLE), "--json", "--silent", cut_off)
        self._wait_until(lambda: bool(simulator.latest), "the simulator did not start")
        talker = self._start("talker", "demo.ros_talker", str(TABLE))
        window = Window()
        with open_screen(console, self._table, DURATION) as screen:
            while simulator.latest["seconds"] < DURATION:
                time.sleep(REFRESH)
                screen.show(window.add(self._snapshot()), listener.latest, simulator.latest)
        self._finish(talker)
        time.sleep(DRAINING)
        self._finish(simulator)
        time.sleep(SETTLING)
        return judge(self._table, listener.latest, simulator.latest, window.add(self._snapshot()))

    def _wait_until_up(self, listener: Child) -> None:
        """Until the ROS listener has found the router's topics: before that, the router withholds messages."""
        self._wait_until(
            lambda: bool(listener.latest) and all(topic["publishers"] for topic in listener.latest["topics"].values()),
            "router and ROS listener did not find each other",
        )
        time.sleep(MATCHING)

    def _wait_until(self, holds: Callable[[], bool], complaint: str) -> None:
        deadline = time.monotonic() + START_PATIENCE
        while not holds():
            if time.monotonic() > deadline:
                raise DemoError(f"{complaint} within {START_PATIENCE:.0f} s")
            self._check()
            time.sleep(0.1)

    def _snapshot(self) -> Snapshot:
        self._check()
        try:
            return parse_metrics(scrape(self._metrics), time.monotonic())
        except TransportError:
            self._check()  # a router that has ended has better words than a refused connection
            raise

    def _check(self) -> None:
        """Nobody ends by itself."""
        for child in self._running:
            _check_exit(child, expected=None)

    def end(self) -> None:
        """All are asked to end before any is waited for; nothing interrupts this."""
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)
        for child in self._running:
            child.ask_to_end()
        for child in self._running:
            child.end()


def _check_exit(child: Child, expected: int | None) -> None:
    if child.exit_code != expected:
        raise DemoError(f"the {child.name} ended with exit code {child.exit_code}:\n{child.last_words()}")


def leave(number: int, frame: FrameType | None) -> None:
    """Every signal that ends the demo goes through its `finally`."""
    raise SystemExit(128 + number)


def play(console: Console) -> list[Finding]:
    """Raises DemoError, or TableError for a broken table."""
    table = read_table(TABLE)
    if problems := taken_places(table):
        told = "\n  ".join(problems)
        raise DemoError(f"addresses of {TABLE} are taken; does another demo, router or simulator run?\n  {told}")
    demo = Demo(table)
    try:
        return demo.run(console)
    finally:
        demo.end()


def tell(console: Console, findings: list[Finding]) -> int:
    """The verdict, and the exit code that belongs to it."""
    verdicts = Table.grid(padding=(0, 2))
    for finding in findings:
        mark = Text("ok", style="green") if finding.ok else Text("FAIL", style="red")
        verdicts.add_row(mark, Text(finding.text))
    console.print(verdicts)
    if all(finding.ok for finding in findings):
        console.print(
            "\nIt works: boards, basestation and real ROS 2 heard each other, and a lost link stopped the rover.\n",
            style="bold",
        )
        console.print(NEXT_STEPS, highlight=False)
        return 0
    console.print("\nThe demo failed: see the lines above.", style="bold red")
    return 1


def main() -> int:
    os.chdir(ROOT)
    for number in ENDING:
        signal.signal(number, leave)
    console = Console()
    console.print(f"Starting router, simulated rover and two ROS 2 nodes on {TABLE} ...", highlight=False)
    try:
        findings = play(console)
    except RouterError as error:
        console.print(f"The demo cannot run: {error}", style="red", highlight=False, markup=False)
        return 1
    return tell(console, findings)


if __name__ == "__main__":
    sys.exit(main())

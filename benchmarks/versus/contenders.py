"""Who is measured, as data, and how each is started. Knows no scenario and measures nothing."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.versus.building import PEER, PROGRAMS
from tests.ports import free_port

TABLES = Path(__file__).parent.parent / "tables"
PAYLOADS = PEER / "payloads.txt"
LISTENERS = 8

_WITHOUT_CAPABILITY = ("setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice")
ORDINARY = (*(_WITHOUT_CAPABILITY if os.geteuid() == 0 else ()), "prlimit", "--rtprio=0:0")
"""Starts a program without the right to a real-time priority: as an ordinary user."""
REALTIME = ("chrt", "--fifo", "1")
"""Starts a program with the real-time priority that the service's router gives to its own threads."""


def datagrams(payloads: Path) -> list[tuple[str, bytes]]:
    """What a file of datagrams holds, each with its payload case, in the order in which they are sent in turns."""
    lines = (line.split() for line in payloads.read_text().splitlines())
    return [(words[0], bytes.fromhex(words[1])) for words in lines if words and words[0] != "#"]


def payload_cases(payloads: Path) -> list[str]:
    """Those that take turns, in their order."""
    return [case for case, _ in datagrams(payloads)]


@dataclass(frozen=True)
class Ports:
    """All that a contender may bind or send to, on the loopback interface."""

    listen: tuple[int, ...]
    first: int
    second: int
    metrics: int

    @staticmethod
    def free() -> Ports:
        found: set[int] = set()
        while len(found) < LISTENERS + 3:
            found.add(free_port())
        first, second, metrics, *listen = found
        return Ports(tuple(listen), first, second, metrics)

    def variables(self) -> dict[str, str]:
        """As the tables name them."""
        named = {"FIRST_PORT": self.first, "SECOND_PORT": self.second, "METRICS_PORT": self.metrics}
        named |= {f"LISTEN_PORT_{number}" if number else "LISTEN_PORT": port for number, port in enumerate(self.listen)}
        return {name: str(port) for name, port in named.items()}


@dataclass(frozen=True)
class Router:
    """`copies`: how many datagrams leave for each that comes. `listens`: whether it takes any. `payloads`: which.

    `board`: host and port of a board to which a deadman sends at the start. `realtime`: whether it may take a real-time
    priority, as the service may.
    """

    name: str
    table: Path
    copies: int = 1
    listens: bool = True
    payloads: Path = PAYLOADS
    board: tuple[str, int] | None = None
    realtime: bool = False

    def words(self, _: Ports) -> list[object]:
        start = () if self.realtime else ORDINARY
        return [*start, sys.executable, "-m", "router", "run", self.table, "--log-level", "error"]

    def environment(self, ports: Ports) -> dict[str, str]:
        """Without what the wheels set in ours, so that it starts as from a shell."""
        inherited = {name: value for name, value in os.environ.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        return inherited | ports.variables()


@dataclass(frozen=True)
class Native:
    """One of our C and C++ programs, with further `options`. `realtime`: it runs at the router's real-time priority."""

    name: str
    program: str
    options: tuple[str, ...] = ()
    copies: int = 1
    listens: bool = True
    payloads: Path = PAYLOADS
    board: None = None
    realtime: bool = False

    def words(self, ports: Ports) -> list[object]:
        start = REALTIME if self.realtime else ()
        to = [word for port in (ports.first, ports.second)[: self.copies] for word in ("--to", f"127.0.0.1:{port}")]
        return [*start, PROGRAMS / self.program, "--listen", f"127.0.0.1:{ports.listen[0]}", *to, *self.options]

    def environment(self, _: Ports) -> dict[str, str]:
        """With what the wheels set in ours: it finds ROS's libraries by it."""
        return dict(os.environ)


Contender = Router | Native

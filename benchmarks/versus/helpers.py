"""The programs around the one under test: generator, sinks, ROS subscriber and publisher. All share one core.

Each answers in lines of JSON. They know nothing of the router; what their answers mean is said where they are used.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

from benchmarks.versus.building import PROGRAMS
from benchmarks.versus.contenders import PAYLOADS
from benchmarks.versus.processes import cores, spawn

POLL_US = 1000
"""How often a sink looks that costs the sender no wake-ups, as if the receiver were another machine."""

KEEPS_UP = 0.97
"""Of the rate that is asked of a generator, what it has to reach."""

BUSY = 4
SETTLE_SECONDS = 1.0

BEGINNING_S = 30.0
"""How long a helper may take to begin on a busy machine."""

SENSOR_BOARD = "127.0.0.30:0"
STAMPED_CASE = "gps_info"


@dataclass(frozen=True)
class Topic:
    """Which payload case it carries, its name and its ROS type."""

    case: str
    name: str
    kind: str


IMU = Topic("imu_info", "imu_data", "comms/msg/ImuSensorInformation")
GPS = Topic("gps_info", "gps_data", "comms/msg/SensorBoardGPSInfo")
ALL_TOPICS = (
    IMU,
    GPS,
    Topic("ph_info", "ph_data", "comms/msg/SensorBoardPHInfo"),
    Topic("sensor_diag", "sensor_board_diagnostics", "comms/msg/SensorBoardDiagnostics"),
)


class Helper(AbstractContextManager["Helper"]):
    """A program on the helpers' core, gone at the latest when its context ends."""

    def __init__(self, *words: object, priority: int | None = 0) -> None:
        self._process = spawn(words, cores().helpers, priority, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._in, self._out = cast("IO[str]", self._process.stdin), cast("IO[str]", self._process.stdout)

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def result(self) -> dict[str, Any]:
        """Its next line."""
        if not (line := self._out.readline()):
            sys.exit(f"{self._process.args!r} ended without a result")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def fileno(self) -> int:
        """Readable when a result is there."""
        return self._out.fileno()

    def is_running(self) -> bool:
        return self._process.poll() is None

    def go(self) -> None:
        """Lets a helper begin that waits for it."""
        self._in.write("go\n")
        self._in.flush()

    def ask(self, number: signal.Signals = signal.SIGUSR1) -> dict[str, Any]:
        self._process.send_signal(number)
        return self.result()

    def stop(self) -> dict[str, Any]:
        """Ends it; what it has to say at the end."""
        return self.ask(signal.SIGTERM)


@contextmanager
def busy() -> Iterator[Sequence[subprocess.Popen[bytes]]]:
    """Processes that use both cores as much as they get."""
    both = {cores().subject, cores().helpers}
    words = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, {both})\nwhile True: pass"]
    with ExitStack() as opened:
        children = []
        for _ in range(BUSY):
            children.append(child := subprocess.Popen(words))
            opened.callback(child.wait)
            opened.callback(child.kill)
        time.sleep(SETTLE_SECONDS)
        yield children


def load(
    ports: Sequence[int],
    rate: float,
    seconds: float,
    burst: int = 1,
    payloads: Path = PAYLOADS,
    case: str = "",
    stamped: bool = False,
    source: str = SENSOR_BOARD,
    priority: int | None = -10,
) -> Helper:
    """Sends the payloads in turn, to the ports in turn, at most `burst` at once; tells at the end what it sent."""
    words = ["--from", source, "--payloads", payloads, "--rate", rate, "--seconds", seconds, "--burst", burst]
    words += [word for port in ports for word in ("--to", f"127.0.0.1:{port}")]
    words += ["--case", case] if case else []
    words += ["--stamp"] if stamped else []
    return Helper(PROGRAMS / "load", *words, priority=priority)


def sink(*ports: int, wakes: bool = False, priority: int | None = -5) -> Helper:
    """Drains ports and counts. With `wakes` each datagram wakes it, as latency needs it."""
    words = [word for port in ports for word in ("--listen", f"127.0.0.1:{port}")]
    words += [] if wakes else ["--poll-us", str(POLL_US)]
    helper = Helper(PROGRAMS / "sink", *words, priority=priority)
    _wait_until_bound(ports)
    time.sleep(0.2)
    return helper


def _wait_until_bound(ports: Sequence[int]) -> None:
    """A sink that runs while nothing else wants to may take seconds to begin. Exits after BEGINNING_S."""
    wanted = {f"0100007F:{port:04X}" for port in ports}
    until = time.monotonic() + BEGINNING_S
    while not wanted <= {line.split()[1] for line in Path("/proc/net/udp").read_text().splitlines()[1:]}:
        if time.monotonic() > until:
            sys.exit(f"a sink has not bound ports {', '.join(map(str, ports))} within {BEGINNING_S:g} s")
        time.sleep(0.01)


def _probe(*words: object) -> Helper:
    """One that has found the other side."""
    helper = Helper(sys.executable, "-m", "benchmarks.versus.probe", *words, priority=-10)
    helper.result()
    time.sleep(0.5)  # found in the graph is not yet matched on the wire
    return helper


def subscriber(topics: Sequence[Topic]) -> Helper:
    return _probe("subscribe", *(f"{topic.name}:{topic.kind}" for topic in topics))


def first_message(topic: Topic) -> Helper:
    """A subscriber, ready before the topic is there, with a result as soon as a message comes."""
    return _probe("first", f"{topic.name}:{topic.kind}")


def publisher(rate: float, seconds: float) -> Helper:
    """Publishes on `arm_target`, once it is told to go."""
    return _probe("publish", "--rate", rate, "--seconds", seconds)

"""The computers of a fleet as processes on one machine: hub, routers, boards, operators.

Certificates, rules and the table's gateway are made by the commands and programs of docs/guides/fleet.md.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.fleet.actors import Address, Told, play_boards, play_operator
from router.errors import TransportError
from router.observe.snapshot import Snapshot
from router.tools.running_router import metrics
from tests.docs_commands import typed, written

ROOT = Path(__file__).resolve().parent.parent.parent
PAGE = ROOT / "docs" / "guides" / "fleet.md"
PATIENCE = 120.0
"""Seconds that something may take on a busy machine."""

AT_ONCE = 4
"""Routers that start together."""

CUT_OFF = "127.0.4."
"""Network of the addresses from which routers connect to the hub; the last number is the rover's."""

PROTO = """\
syntax = "proto3";
message Envelope { oneof payload { Imu imu = 1; Drive drive = 2; Brake brake = 3; } }
message Imu { float number = 1; float gyro_x = 2; float gyro_y = 3; float gyro_z = 4; }
message Drive { double number = 1; }
message Brake { bool brake = 1; }
"""
TABLE = """\
version: 1
envelope: {protos: protos, message: Envelope, oneof: payload}
node: {name: rover}
http: {address: "127.0.1.${NUMBER}:9108"}
listen: {rover: {address: "127.0.1.${NUMBER}:5000"}}
endpoints:
  sensor_board: {address: "127.0.2.${NUMBER}:8", kind: board}
  driving_board: {address: "127.0.3.${NUMBER}:8", kind: board}
routes:
  imu:
    source: sensor_board
    topics:
      - topic: imu
        type: sensor_msgs/msg/Imu
        fields:
          header: {stamp: received_at, frame_id: {text: imu_link}}
          angular_velocity: {x: gyro_x, y: gyro_y, z: gyro_z}
          linear_acceleration: {x: number}
  drive:
    source: {topic: drive, type: geometry_msgs/msg/Twist}
    destinations: driving_board
    fields: {number: linear.x}
    ttl: 200ms
    deadman: {timeout: 500ms, repeat: 100ms, send: {brake: {brake: true}}}
  brake: {ignore: the deadman's}
"""
"""Every rover's, without its gateway."""

GATEWAY = """\
    publish_period: each
    topics: {include: [/imu]}
    inbound:
      - {topic: drive, type: geometry_msgs/msg/Twist, ttl: 200ms}
"""
"""The gateway sends every message of one topic, where the guide's sends all topics twice a second. There is no
`max_rate`, so that commands which come together are all delivered.
"""


def table() -> str:
    """One table for all rovers: the guide's gateway below routes of two messages."""
    gateways = written(PAGE)["rover.yaml"].partition("gateways:\n")[2].partition("    inbound:\n")[0]
    hub = "tls/127.0.0.1:7447"
    return f"{TABLE}gateways:\n{gateways}{GATEWAY}".replace(hub, f'"{hub}#bind={CUT_OFF}${{NUMBER}}:0"')


class Fleet:
    """Rovers and operators have numbers from 1 on; a rover has one operator."""

    def __init__(
        self, folder: Path, rovers: int, operators: int, rates: tuple[float, float], opened: ExitStack
    ) -> None:
        self.folder = folder
        self.drivers = {rover: 1 + (rover - 1) * operators // rovers for rover in range(1, rovers + 1)}
        self._rates = rates
        self._opened = opened
        self.routers: dict[int, subprocess.Popen[bytes]] = {}
        self.operators: dict[int, Actor] = {}
        self._prepare()
        self.start_hub()
        addresses = [
            Address(rover, f"127.0.1.{rover}", f"127.0.2.{rover}", f"127.0.3.{rover}") for rover in self.drivers
        ]
        self.boards = opened.enter_context(actor(play_boards, addresses, rates[0]))

    def _prepare(self) -> None:
        (self.folder / "protos").mkdir()
        (self.folder / "protos" / "envelope.proto").write_text(PROTO)
        (self.folder / "rover.yaml").write_text(table())
        drivers = {f"rover_{rover}": [f"operator_{operator}"] for rover, operator in self.drivers.items()}
        program = re.sub(r"^DRIVERS = .*$", f"DRIVERS = {drivers}", written(PAGE)["fleet.py"], flags=re.MULTILINE)
        (self.folder / "fleet.py").write_text(program)
        hub = written(PAGE)["hub.py"].replace("signal.pause()", "print('open', flush=True)\nsignal.pause()")
        (self.folder / "hub.py").write_text(hub)
        names = " ".join(["hub", *drivers, *(f"operator_{number}" for number in set(self.drivers.values()))])
        for command in (command for command in typed(PAGE) if "openssl" in command):
            made = re.sub(r"in hub .*? ben;", f"in {names};", command)
            subprocess.run(["/bin/sh", "-e", "-c", made], cwd=self.folder, check=True, capture_output=True)
        subprocess.run([sys.executable, "fleet.py"], cwd=self.folder, check=True)

    def start_hub(self) -> None:
        """Start the hub by the guide's command. Return when it takes connections."""
        [command] = [command.removesuffix(" &") for command in typed(PAGE) if "python hub.py" in command]
        environment, _, _ = command.partition("python")
        log = self.folder / "hub.log"
        log.unlink(missing_ok=True)
        shell = f"{environment} exec {sys.executable} hub.py >{log.name} 2>&1"
        self.hub = subprocess.Popen(["/bin/sh", "-c", shell], cwd=self.folder)
        self._opened.callback(end, self.hub)
        wait_until(lambda: log.exists() and "open\n" in log.read_text(), "the hub")

    def start(self, rovers: Sequence[int]) -> None:
        """Start routers, a few at a time, and the operators that they need; return when every gateway serves."""
        for first in range(0, len(rovers), AT_ONCE):
            some = rovers[first : first + AT_ONCE]
            for rover in some:
                self._start_router(rover)
            for rover in some:
                wait_until(lambda rover=rover: self._serves(rover), f"rover {rover}")
        for operator in sorted({self.drivers[rover] for rover in rovers} - self.operators.keys()):
            his = [rover for rover, driver in self.drivers.items() if driver == operator]
            config = (self.folder / f"operator_{operator}.json5").read_text()
            self.operators[operator] = self._opened.enter_context(actor(play_operator, config, his, self._rates[1]))

    def _start_router(self, rover: int) -> None:
        environment = {
            **os.environ,
            "ROVER": f"rover_{rover}",
            "NUMBER": str(rover),
            "CERTIFICATES": str(self.folder),
            "ROS_DOMAIN_ID": str(rover),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(self.folder),
        }
        command = [sys.executable, "-m", "router", "run", "rover.yaml"]
        with (self.folder / f"rover_{rover}.log").open("w") as log:
            running = subprocess.Popen(command, cwd=self.folder, env=environment, stderr=log)
        self.routers[rover] = running
        self._opened.callback(end, running)

    def cut(self, rovers: Sequence[int]) -> None:
        """Drop all packets between these rovers and the hub, in both directions, until `mend`."""
        addresses = ", ".join(f"{CUT_OFF}{rover}" for rover in rovers)
        chain = "type filter hook output priority 0;"
        rules = f"ip saddr {{ {addresses} }} drop; ip daddr {{ {addresses} }} drop;"
        filter_packets(f"table ip cut {{ chain cut {{ {chain} {rules} }}; }}")

    def mend(self) -> None:
        filter_packets("delete table ip cut")

    def _serves(self, rover: int) -> bool:
        if self.routers[rover].poll() is not None:
            raise SystemExit((self.folder / f"rover_{rover}.log").read_text())
        try:
            return self.scrape(rover).total("gateway_clients", "fleet") == 1
        except TransportError:
            return False

    def scrape(self, rover: int) -> Snapshot:
        return metrics(f"http://127.0.1.{rover}:9108")


def filter_packets(command: str) -> None:
    subprocess.run(["nft", command], check=True)  # noqa: S607


def end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def wait_until(condition: Any, what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"{what} never came")
        time.sleep(0.05)


class Actor:
    """A process that does what it is told over a pipe."""

    def __init__(self, process: Any, pipe: Connection) -> None:
        self.process = process
        self._pipe = pipe

    def tell(self, order: str, *values: Any) -> Any:
        """Return the answer."""
        self._pipe.send((order, values))
        return self._pipe.recv()

    def take(self) -> Told:
        """What it recorded since it was asked last."""
        return Told(*self.tell("take"))

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


@contextmanager
def actor(main: Any, *arguments: Any) -> Iterator[Actor]:
    context = get_context("spawn")
    ours, its = context.Pipe()
    process = context.Process(target=main, args=(its, *arguments), daemon=True)
    process.start()
    try:
        ours.recv()
        yield Actor(process, ours)
    finally:
        process.kill()
        process.join()


def cpu_ns(pid: int) -> int:
    """Of all living threads."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[0]) for task in tasks)


def entries(pid: int, kind: str) -> int:
    """The number of threads (`task`) or open files (`fd`)."""
    return len(list(Path(f"/proc/{pid}/{kind}").iterdir()))


def memory(pid: int) -> Mapping[str, float]:
    """MB: resident, and the part that is this process's own."""
    lines = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    kb = {words[0]: int(words[1]) for words in lines}
    own = kb["Private_Clean:"] + kb["Private_Dirty:"]
    return {"rss": round(kb["Rss:"] / 1024, 1), "private": round(own / 1024, 1)}

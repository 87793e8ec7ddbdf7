"""A router in a process of its own, with everything around it: boards and basestation as sockets, scraper, log."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import HOSTS, ROUTER, TOPICS_FROM_ROS
from tests.ports import free_port

ROOT = Path(__file__).parent.parent.parent

ROVER = """\
version: 1
extends: {root}/tests/acceptance/patient.yaml
http:
  address: 127.0.0.1:{metrics}
listen:
  rover:
    address: 127.0.0.5:{listen}
endpoints:
{endpoints}"""
"""The rover's table with loopback addresses, to be filled in by `Site.table`."""

BARE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}
"""
"""A table without routes, to be filled in likewise."""

IMPATIENT_ROVER = ROVER.replace("patient.yaml", "quiet.yaml")
"""With the rover's own times for what is stale, and for its deadmen."""


SO_MEMINFO = 55
"""Of Linux; word 8 of what it tells are the datagrams dropped."""

SERVED = "route_duration_seconds_count"
"""Counts the messages whose targets have all been served."""


_COMMAND = re.compile(r'command="\w+",?')


def key(metric: str, **labels: str) -> str:
    """A counter as Prometheus writes it, without the prefix."""
    return f"{metric}{{{','.join(f'{name}={json.dumps(labels[name])}' for name in sorted(labels))}}}"


def samples_in(text: str) -> dict[str, float]:
    """The samples of /metrics, without the prefix `router_` and the label `command`, which follows from others."""
    lines = (_COMMAND.sub("", line).rpartition(" ") for line in text.splitlines() if line.startswith("router_"))
    return {name[len("router_") :]: float(value) for name, _, value in lines}


def wait_until(condition: Callable[[], bool], what: str = "it") -> None:
    deadline = monotonic() + PATIENCE
    while not condition():
        assert monotonic() < deadline, f"{what} never happened"
        sleep(0.01)


class RouterProcess:
    """`router run ARGUMENT...` as a child process, whose log goes to a file. `within` is a command that runs it."""

    module = "tests.acceptance.uncached_router"

    def __init__(self, folder: Path, *arguments: object, within: Sequence[str] = (), **environment: str) -> None:
        self._log = folder / "router.log"
        folders = (environment.pop("PYTHONPATH", None), str(ROOT), os.environ.get("PYTHONPATH"))
        environment.setdefault("FOXGLOVE", f"127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}")  # the rover's has one
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                [*within, sys.executable, "-m", self.module, "run", *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                stderr=log,
                env={**os.environ, **environment, "PYTHONPATH": os.pathsep.join(filter(None, folders))},
            )

    def __enter__(self) -> RouterProcess:
        with self._or_killed():
            wait_until(lambda: self.process.poll() is not None or bool(self.events("router started")), "the start")
            assert self.process.poll() is None, self.text()
        return self

    def __exit__(self, *_: object) -> None:
        with self._or_killed():
            if self.process.poll() is None:
                assert self.stop(signal.SIGTERM) == 0, self.text()

    @contextmanager
    def _or_killed(self) -> Iterator[None]:
        """A router that is left running would subscribe to the topics of other tests."""
        try:
            yield
        except BaseException:
            self.process.kill()
            raise

    def stop(self, number: signal.Signals) -> int:
        """Sends the signal, waits, and gives the exit code."""
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        return self.process.wait(PATIENCE)

    @contextmanager
    def standing_still(self) -> Iterator[None]:
        """Stops all of its threads meanwhile."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            wait_until(self._is_stopped, "the stop")
            yield
        finally:
            self.process.send_signal(signal.SIGCONT)

    def _is_stopped(self) -> bool:
        threads = Path(f"/proc/{self.process.pid}/task").glob("*/stat")
        return all(thread.read_text().rpartition(")")[2].split()[0] == "T" for thread in threads)

    def text(self) -> str:
        """What it has written to stderr so far."""
        return self._log.read_text()

    def log(self) -> list[dict[str, Any]]:
        """Its lines of JSON; the last one may still be in the making."""
        return [json.loads(line) for line in self.text().splitlines() if line.startswith("{") and line.endswith("}")]

    def events(self, event: str) -> list[dict[str, Any]]:
        return [line for line in self.log() if line["event"] == event]


@dataclass
class Site:
    """Sockets of all endpoints, each on an address of its own, and free ports for a router that is to be started."""

    folder: Path
    endpoints: Mapping[str, socket.socket]
    listen: int
    metrics: int

    def table(self, text: str = ROVER) -> Path:
        """Writes a table whose placeholders are filled in."""
        lines = (
            f"  {name}: {{address: {host}:{port}, kind: {_kind(name)}}}\n"
            for name, (host, port) in ((name, opened.getsockname()) for name, opened in self.endpoints.items())
        )
        path = self.folder / "table.yaml"
        path.write_text(text.format(listen=self.listen, metrics=self.metrics, endpoints="".join(lines), root=ROOT))
        return path

    def send(self, source: str, *datagrams: bytes) -> None:
        for datagram in datagrams:
            self.endpoints[source].sendto(datagram, (ROUTER, self.listen))

    def receive(self, endpoint: str) -> bytes:
        return self.endpoints[endpoint].recv(65536)

    def waiting(self) -> dict[str, list[bytes]]:
        """Everything that has arrived anywhere and was not received, by endpoint."""
        found = {name: list(_drained(opened)) for name, opened in self.endpoints.items()}
        return {name: datagrams for name, datagrams in found.items() if datagrams}

    def scrape(self) -> Counter[str]:
        """All counters of the router and what waits, without the prefix `router_` and the suffix `_total`."""
        return Counter(
            {
                name.replace("_total{", "{"): int(value)
                for name, value in self.samples().items()
                if "_total{" in name or name.startswith((SERVED, "messages_waiting{"))
            }
        )

    def samples(self) -> dict[str, float]:
        """Everything that the router tells of itself."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics}/metrics", timeout=PATIENCE) as answer:
            text = answer.read().decode()
        return samples_in(text)

    def changes(self, before: Counter[str]) -> Counter[str]:
        """What was counted since `before`, without what stayed as it was."""
        return self.scrape() - before

    def settle(self, before: Counter[str], datagrams: int, messages: int = 0) -> Counter[str]:
        """Waits until the router is done with so much since `before`; what was counted meanwhile.

        `messages` are those from ROS.
        """

        now = Counter[str]()

        def done() -> bool:
            nonlocal now
            now = self.changes(before)
            received, lost = total(now, "datagrams_received"), total(now, "kernel_drops")
            finished = total(now, "datagrams_rejected") + total(now, SERVED)
            waiting = total(now, "messages_waiting")
            return received + lost >= datagrams and finished == received + messages and not waiting

        wait_until(done, "the last datagram")
        return Counter({name: count for name, count in now.items() if not name.startswith(SERVED)})


def total(counts: Mapping[str, int], metric: str, **labels: str) -> int:
    """The sum of a metric's series, or of those that have these labels."""
    wanted = [f'{name}="{value}"' for name, value in labels.items()]
    return sum(
        count
        for name, count in counts.items()
        if name.startswith(f"{metric}{{") and all(label in name[len(metric) :] for label in wanted)
    )


def balance(counts: Mapping[str, int], topics: Iterable[str] = TOPICS_FROM_ROS) -> None:
    """The identities of the counters: nothing that was received is unaccounted for. From `topics` messages come."""
    accepted = total(counts, "messages_received")
    from_ros = sum(total(counts, "messages_received", source=topic) for topic in topics)
    assert total(counts, "datagrams_received") == total(counts, "datagrams_rejected") + accepted - from_ros
    for route in labels_of(counts, "messages_received", "route"):
        taken = total(counts, "messages_received", route=route)
        for target in labels_of(counts, "messages_filtered", "target", route=route):
            delivered = total(counts, "datagrams_sent", route=route, destination=target)
            delivered += total(counts, "messages_published", route=route, topic=target)
            others = ("messages_filtered", "messages_dropped", "messages_collected", "messages_waiting")
            assert taken == delivered + sum(total(counts, metric, route=route, target=target) for metric in others)


def labels_of(counts: Mapping[str, int], metric: str, label: str, **labels: str) -> set[str]:
    """Which values a label has among a metric's series."""
    wanted = [f'{name}="{value}"' for name, value in labels.items()]
    names = (name for name in counts if name.startswith(f"{metric}{{") and all(text in name for text in wanted))
    return {match[1] for name in names if (match := re.search(rf'[{{,]{label}="([^"]*)"', name))}


def _kind(endpoint: str) -> str:
    return "board" if endpoint.endswith("board") else "basestation" if endpoint == "basestation" else "tool"


def _drained(opened: socket.socket) -> Iterator[bytes]:
    opened.setblocking(False)
    try:
        while True:
            yield opened.recv(65536)
    except BlockingIOError:
        opened.settimeout(PATIENCE)


def arrived(opened: socket.socket, before: int = 0) -> int:
    """How many datagrams came to a socket and were not received yet, those included that its buffer had no room for.

    `before` is how many had found no room earlier (`no_room`).
    """
    return len(list(_drained(opened))) + no_room(opened) - before


def no_room(opened: socket.socket) -> int:
    words = struct.unpack("9I", opened.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 36))
    return int(words[8])


def udp(host: str, port: int = 0) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    opened.bind((host, port))
    opened.settimeout(PATIENCE)
    return opened


@contextmanager
def site(folder: Path, hosts: Mapping[str, str] = HOSTS) -> Iterator[Site]:
    with ExitStack() as opened:
        endpoints = {name: opened.enter_context(udp(host)) for name, host in hosts.items()}
        yield Site(folder, endpoints, free_port(ROUTER), free_port(kind=socket.SOCK_STREAM))

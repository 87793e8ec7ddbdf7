"""A router in a separate process and its surroundings: sockets of boards and basestation, scraper, log."""

from __future__ import annotations

import json
import re
import signal
import socket
import struct
import subprocess
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
from tests.routers import start
from tests.tasks import of_threads

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
"""The rover's table with loopback addresses; `Site.table` fills in the placeholders."""

BARE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}
"""
"""A table without routes, with the same placeholders."""

IMPATIENT_ROVER = ROVER.replace("patient.yaml", "quiet.yaml")
"""With the rover's own times for staleness and deadmen."""


SO_MEMINFO = 55
"""Socket option of Linux; word 8 of the result is the number of dropped datagrams."""

SERVED = "route_duration_seconds_count"
"""The metric that counts messages whose targets have all been served."""

SILENCES = "endpoint_silences"
"""The metric that counts pauses of endpoints, which depend on how fast the tests run."""


_COMMAND = re.compile(r'command="\w+",?')


def key(metric: str, **labels: str) -> str:
    """The name of a counter in Prometheus' text format, without the prefix."""
    return f"{metric}{{{','.join(f'{name}={json.dumps(labels[name])}' for name in sorted(labels))}}}"


def samples_in(text: str) -> dict[str, float]:
    """The samples of /metrics, without the prefix `router_` and the label `command`, which the other labels imply."""
    lines = (_COMMAND.sub("", line).rpartition(" ") for line in text.splitlines() if line.startswith("router_"))
    return {name[len("router_") :]: float(value) for name, _, value in lines}


def wait_until(condition: Callable[[], bool], what: str = "it") -> None:
    deadline = monotonic() + PATIENCE
    while not condition():
        assert monotonic() < deadline, f"{what} never happened"
        sleep(0.01)


class RouterProcess:
    """`router run ARGUMENT...` as a child process that logs to a file. `within` is a command to run it with."""

    module = "tests.acceptance.uncached_router"

    def __init__(self, folder: Path, *arguments: object, within: Sequence[str] = (), **environment: str) -> None:
        self._log = folder / "router.log"
        path = environment.pop("PYTHONPATH", "")
        with self._log.open("w") as log:
            self.process = start(
                ("-m", self.module),
                "run",
                *arguments,
                within=within,
                path=path,
                environment=environment,
                stdin=subprocess.DEVNULL,
                stdout=None,
                stderr=log,
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
        """Kill the router on failure: left running, it would subscribe to the topics of other tests."""
        try:
            yield
        except BaseException:
            self.process.kill()
            raise

    def stop(self, number: signal.Signals) -> int:
        """Send the signal, wait, and return the exit code."""
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        return self.process.wait(PATIENCE)

    @contextmanager
    def standing_still(self) -> Iterator[None]:
        """Stop all threads of the router meanwhile."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            wait_until(self._is_stopped, "the stop")
            yield
        finally:
            self.process.send_signal(signal.SIGCONT)

    def _is_stopped(self) -> bool:
        states = of_threads(self.process.pid, lambda task: (task / "stat").read_text().rpartition(")")[2].split()[0])
        return set(states) == {"T"}

    def text(self) -> str:
        """The router's stderr so far."""
        return self._log.read_text()

    def log(self) -> list[dict[str, Any]]:
        """The router's log entries; the last line may be incomplete."""
        return [json.loads(line) for line in self.text().splitlines() if line.startswith("{") and line.endswith("}")]

    def events(self, event: str) -> list[dict[str, Any]]:
        return [line for line in self.log() if line["event"] == event]


@dataclass
class Site:
    """Sockets of all endpoints, each at a different address, and free ports for a router."""

    folder: Path
    endpoints: Mapping[str, socket.socket]
    listen: int
    metrics: int

    def table(self, text: str = ROVER) -> Path:
        """Write a table with the placeholders filled in."""
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
        """The datagrams that have arrived and were not read, by endpoint."""
        found = {name: list(_drained(opened)) for name, opened in self.endpoints.items()}
        return {name: datagrams for name, datagrams in found.items() if datagrams}

    def scrape(self) -> Counter[str]:
        """All counters and queue lengths of the router, without the prefix `router_` and the suffix `_total`."""
        return Counter(
            {
                name.replace("_total{", "{"): int(value)
                for name, value in self.samples().items()
                if "_total{" in name or name.startswith((SERVED, "messages_waiting{"))
            }
        )

    def samples(self) -> dict[str, float]:
        """All metrics of the router."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics}/metrics", timeout=PATIENCE) as answer:
            text = answer.read().decode()
        return samples_in(text)

    def changes(self, before: Counter[str]) -> Counter[str]:
        """The counters that changed since `before`, as differences."""
        return self.scrape() - before

    def settle(self, before: Counter[str], datagrams: int, messages: int = 0) -> Counter[str]:
        """Wait until the router has processed this much since `before`, and return the changed counters.

        `messages` are messages from ROS.
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
        return Counter({name: count for name, count in now.items() if not name.startswith((SERVED, SILENCES))})


def total(counts: Mapping[str, int], metric: str, **labels: str) -> int:
    """The sum of a metric's series, or of its series with these labels."""
    wanted = [f'{name}="{value}"' for name, value in labels.items()]
    return sum(
        count
        for name, count in counts.items()
        if name.startswith(f"{metric}{{") and all(label in name[len(metric) :] for label in wanted)
    )


def balance(counts: Mapping[str, int], topics: Iterable[str] = TOPICS_FROM_ROS) -> None:
    """Check that the counters account for every received message. `topics` are the sources of routes from ROS."""
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
    """The values of a label among a metric's series."""
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
    """The number of datagrams that arrived at a socket and were not read, including those dropped by a full buffer.

    `before` is the number of earlier drops (`no_room`).
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

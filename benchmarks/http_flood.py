"""What routing suffers while clients flood the router's HTTP port, and who else is answered meanwhile.

    python -m benchmarks.http_flood                    # every kind of flood
    python -m benchmarks.http_flood unread storm --clients 100 --seconds 6

A router runs the rover's table and gets 1,000 datagrams a second, and drive commands at 20 Hz. Beside them clients do
one of FLOODS to its HTTP port, and connect again as soon as they are cut off. Meanwhile `/ready` is asked twice a
second and the table is reloaded twice, as a program on the rover would. Prints the latency of forwarding, stale
commands, and the longest times of the answers. Exits 1 above --most, if a command was stale, or if an answer failed or
took longer than 2 s. All on the loopback interface. Needs gcc.
"""

from __future__ import annotations

import argparse
import os
import selectors
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

# Before anything imports rclpy.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from benchmarks.versus.building import PEER, PROGRAMS
from benchmarks.versus.helpers import load, sink
from router.errors import RouterError
from router.tools.running_router import post, tap
from tests.acceptance.payloads import generated
from tests.acceptance.rover_map import HOSTS
from tests.acceptance.site import ROOT, RouterProcess
from tests.ports import free_port

RATE = 1000
COMMAND_SECONDS = 0.05
ANSWER_SECONDS = 2.0
AGAIN_SECONDS = 0.005
"""A client that was cut off connects again after so long."""

TABLE = """\
version: 1
extends: {root}/tests/acceptance/quiet.yaml
http: {{address: 127.0.0.1:{metrics}}}
foxglove: {{address: 127.0.0.1:{foxglove}}}
listen: {{rover: {{address: 127.0.0.1:{listen}}}}}
endpoints:
{endpoints}"""


class Flood(NamedTuple):
    """What each client sends over and over; how much of an answer it takes each time that it looks (0: nothing)."""

    sends: bytes
    takes: int = 0
    pause: float = 0.0
    closes: bool = False
    hosts: int = 1


def _get(path: str, *headers: str, method: str = "GET") -> bytes:
    return "\r\n".join([f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", *headers, "", ""]).encode()


FLOODS = {
    "none": Flood(b""),
    "unread": Flood(_get("/metrics") * 50),
    "unread-gzip": Flood(_get("/metrics", "Accept-Encoding: gzip") * 50),
    "unread-hosts": Flood(_get("/metrics") * 50, hosts=50),
    "read": Flood(_get("/metrics") * 50, takes=1 << 20),
    "read-hosts": Flood(_get("/metrics") * 50, takes=1 << 20, hosts=50),
    "read-gzip": Flood(_get("/metrics", "Accept-Encoding: gzip") * 50, takes=1 << 20),
    "ready": Flood(_get("/ready") * 50, takes=1 << 20),
    "formats": Flood(
        b"".join(_get("/metrics", f"Accept: application/openmetrics-text;version=1.0.{n}") for n in range(50)), 1 << 20
    ),
    "status": Flood(_get("/status.json") * 50),
    "map": Flood((_get("/map.json") + _get("/map.json?width=narrow")) * 50, takes=1 << 20),
    "query": Flood(_get("/map.json?" + "a=1&" * 4000) * 50, takes=1 << 20),
    "headers": Flood(_get("/ready", *(f"A{n}: {'b;' * 70}" for n in range(95))) * 50, takes=1 << 20),
    "page": Flood(_get("/", "Accept-Encoding: gzip") * 50, takes=1 << 20),
    "health": Flood(_get("/healthz") * 50, takes=1 << 20),
    "head": Flood(_get("/metrics", method="HEAD") * 50, takes=1 << 20),
    "tap": Flood(_get("/tap")),
    "orders": Flood(_get("/-/nothing", "Content-Length: 0", method="POST"), takes=1 << 20),
    "silent": Flood(b""),
    "bytes": Flood(b"GET /ready HTTP/1.1\r\nHost: 127.0.0.1\r\nA: " + b"x" * 500, pause=0.1),
    "trickle": Flood(_get("/metrics") * 50, takes=1, pause=1.0),
    "garbage": Flood(bytes(range(256)) * 300, takes=1 << 20),
    "storm": Flood(b"", closes=True),
    "storm-hosts": Flood(b"", closes=True, hosts=200),
    "storm-asks": Flood(_get("/metrics"), closes=True),
    "storm-asks-hosts": Flood(_get("/metrics"), closes=True, hosts=200),
}


class Client:
    """One of a flood, as long as it is connected. Does not block."""

    def __init__(self, flood: Flood, port: int, number: int) -> None:
        self._flood = flood
        self._left = b""
        self.socket = _from(flood, number)
        self.socket.setblocking(False)
        with suppress(BlockingIOError):
            self.socket.connect(("127.0.0.1", port))

    def act(self, events: int) -> bool:
        """Return whether it is connected still."""
        flood = self._flood
        try:
            if events & selectors.EVENT_WRITE and flood.sends:
                self._left = self._left or flood.sends
                most = 1 if flood.pause and not flood.takes else len(self._left)
                self._left = self._left[self.socket.send(self._left[:most]) :]
            if events & selectors.EVENT_READ:
                return bool(self.socket.recv(flood.takes) if flood.takes else self.socket.recv(1, socket.MSG_PEEK))
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True


def _from(flood: Flood, number: int) -> socket.socket:
    opened = socket.socket()
    opened.bind((f"127.0.1.{1 + number % flood.hosts}" if flood.hosts > 1 else "127.0.0.1", 0))
    return opened


def attack(flood: Flood, port: int, clients: int) -> None:
    """Keeps so many connected; never returns."""
    looks = selectors.DefaultSelector()
    due = [0.0] * clients  # when those that are not connected connect, in order
    number = 0
    while True:
        while due and due[0] <= time.monotonic():
            due.pop(0)
            client, number = Client(flood, port, number), number + 1
            looks.register(client.socket, selectors.EVENT_READ | selectors.EVENT_WRITE, client)
        for key, events in looks.select(0.01):
            if not key.data.act(events):
                looks.unregister(key.fileobj)
                key.data.socket.close()
                due.append(time.monotonic() + AGAIN_SECONDS)
        time.sleep(flood.pause or 0.001)


def storm(flood: Flood, port: int) -> None:
    """One connection after the other, as fast as they come; never returns."""
    number = 0
    while True:
        number += 1
        with suppress(OSError), _from(flood, number) as each:
            each.settimeout(1)
            each.connect(("127.0.0.1", port))
            each.sendall(flood.sends)


class Asking:
    """Does something again and again, `period` s apart, in a thread of its own; keeps the longest time and failures."""

    def __init__(self, name: str, period: float, act: Callable[[], object]) -> None:
        self.name, self.longest, self.times, self.failures = name, 0.0, 0, list[str]()
        self._period, self._act, self._closed = period, act, threading.Event()
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _ask(self) -> None:
        while not self._closed.wait(self._period):
            begin = time.monotonic()
            try:
                self._act()
            except (OSError, RouterError) as error:
                self.failures.append(str(error))
            self.times += 1
            self.longest = max(self.longest, time.monotonic() - begin)

    def __str__(self) -> str:
        failed = f", {len(self.failures)} failed ({self.failures[0][:80]})" if self.failures else ""
        return f"{self.name} {self.times} in at most {self.longest * 1e3:.0f} ms{failed}"


class Router(RouterProcess):
    """As it is run on a rover; tests run it without keeping /metrics."""

    module = "router"


def stale(url: str) -> int:
    for _ in range(50):
        try:
            with urllib.request.urlopen(f"{url}/metrics", timeout=10) as answer:  # noqa: S310 - our own address
                text = answer.read().decode()
        except OSError:
            time.sleep(0.1)
            continue
        lines = [line for line in text.splitlines() if line.startswith("router_messages_dropped") and "stale" in line]
        return int(sum(float(line.rpartition(" ")[2]) for line in lines if 'route="manual_drive"' in line))
    raise SystemExit(f"nobody answers at {url}")


@contextmanager
def flooding(name: str, port: int, clients: int) -> Iterator[None]:
    command = [sys.executable, "-m", "benchmarks.http_flood", "--attack", name, "--port", str(port)]
    with subprocess.Popen([*command, "--clients", str(clients)], cwd=ROOT) as process:
        time.sleep(1.5)
        try:
            yield
        finally:
            process.kill()


def ready(url: str) -> None:
    with urllib.request.urlopen(f"{url}/ready", timeout=10) as answer:  # noqa: S310 - our own address
        answer.read()


def reloaded(url: str) -> None:
    if not (answer := post(url, "/-/reload", 10)).ok:
        raise RouterError(str(answer.body))


def tapped(url: str) -> None:
    with tap(url) as batches:
        next(batches)


def run(name: str, clients: int, seconds: float, most: float) -> bool:
    drive = next(generated("manual_drive")).datagram
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        first, listen = free_port("127.0.0.1"), free_port("127.0.0.1")
        metrics, foxglove = (free_port(kind=socket.SOCK_STREAM) for _ in range(2))
        places = {name: f"{host}:{free_port(host)}" for name, host in HOSTS.items()}
        places["basestation"] = f"127.0.0.1:{first}"
        endpoints = "".join(f"  {name}: {{address: '{place}'}}\n" for name, place in places.items())
        path = Path(folder) / "table.yaml"
        values = {"metrics": metrics, "foxglove": foxglove, "listen": listen, "endpoints": endpoints}
        path.write_text(TABLE.format(root=ROOT, **values))
        url = f"http://127.0.0.1:{metrics}"
        router = opened.enter_context(Router(Path(folder), path))
        commander = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        commander.bind(("127.0.0.1", 0))
        with load([listen], RATE, 1.0, case="gps_info", stamped=True) as warm:
            warm.result()
        before = stale(url)
        with flooding(name, metrics, clients if name != "none" else 0), sink(first, wakes=True) as receiver:
            asking = [
                Asking("commands", COMMAND_SECONDS, lambda: commander.sendto(drive, ("127.0.0.1", listen))),
                Asking("ready", 0.5, lambda: ready(url)),
                Asking("tap", 1.0, lambda: tapped(url)),
                Asking("reload", seconds / 2.5, lambda: reloaded(url)),
            ]
            with load([listen], RATE, seconds, case="gps_info", stamped=True) as generator:
                sent = generator.result()["sent"]
            for each in asking:
                each.close()
            [arrived] = receiver.stop()["ports"]
        late = stale(url) - before
        faults = [line for line in router.text().splitlines() if "fault" in line or "Traceback" in line]
    found = {quantile: us / 1e3 for quantile, us in arrived["latency_us"].items()}
    print(f"{name:13}" + "  ".join(f"{quantile} {ms:7.2f}" for quantile, ms in found.items()), "ms", end="; ")
    print(f"{sent - arrived['datagrams']} lost, {late} stale; " + "; ".join(map(str, asking[1:])), flush=True)
    for line in faults[:2]:
        print(line)
    answered = all(not each.failures and each.longest < ANSWER_SECONDS for each in asking if each.name != "tap")
    return found["p99"] < most and not late and answered and not faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("floods", nargs="*", metavar="FLOOD", help=f"of {', '.join(FLOODS)}; default all")
    parser.add_argument("--clients", type=int, default=100, help="default 100")
    parser.add_argument("--seconds", type=float, default=5, help="of each flood; default 5")
    parser.add_argument("--most", type=float, default=20, help="ms, the 99th percentile; default 20")
    parser.add_argument("--attack", choices=FLOODS, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.attack:
        flood = FLOODS[arguments.attack]
        storm(flood, arguments.port) if flood.closes else attack(flood, arguments.port, arguments.clients)
    PROGRAMS.mkdir(parents=True, exist_ok=True)
    for program in ("load", "sink"):
        command = ["gcc", "-O2", "-std=gnu11", str(PEER / f"{program}.c"), "-o", str(PROGRAMS / program)]
        subprocess.run(command, check=True)
    good = [run(name, arguments.clients, arguments.seconds, arguments.most) for name in arguments.floods or FLOODS]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

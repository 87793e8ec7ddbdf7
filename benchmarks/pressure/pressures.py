"""What presses on a running router. Each says at the end whether it really pressed, and by how much."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from benchmarks.pressure.tables import SHARED_MEMORY, Place, table
from benchmarks.versus import helpers
from benchmarks.versus.helpers import Helper
from benchmarks.versus.processes import read
from benchmarks.versus.subject import Subject
from router.errors import RouterError
from router.tools.running_router import post

CLIENTS = 100
FEWEST_CLIENTS = 4
"""Of those, connected at once: a router may refuse more of one host, and they try again all the time."""

BUSY_CORES = 0.5
"""What the busy processes together get at least; nearly both cores where nothing else runs."""

RELOAD_SECONDS = 0.7
SAVE_SECONDS = 1.0
PREFILLED = 60_000
"""Datagrams that a recording holds before it is saved for the first time: a minute at 1,000 per second."""

SETTLE_SECONDS = 1.0


class Proof(NamedTuple):
    """Whether there was pressure, and in figures how much."""

    pressed: bool
    figures: dict[str, float]


class Pressed(NamedTuple):
    """The process under test, and what its table says."""

    subject: Subject
    place: Place


Judge = Callable[[float], Proof]
"""To be asked once, at the end of a run; takes its length in seconds."""


@contextmanager
def alone(_: Pressed) -> Iterator[Judge]:
    yield lambda _: Proof(True, {})


@contextmanager
def _subscribed(*within: str) -> Iterator[Judge]:
    """A process, started by a command, subscribes to all topics."""
    with _actor("subscriber", within=within) as helper:
        found = helper.result()
        time.sleep(SETTLE_SECONDS)  # found in the graph is not yet matched on the wire
        helper.ask()
        is_apart = found["shared_memory"] != SHARED_MEMORY.stat().st_dev
        ports = _shared_ports()
        with _repeated(0.02, _shared_ports) as seen:

            def judge(_: float) -> Proof:
                received = helper.ask()["count"]
                changes = sum(before != after for before, after in pairwise([ports, *seen]))
                figures = {"subscriptions": found["subscriptions"], "received": received, "ports_recreated": changes}
                return Proof(found["subscriptions"] > 0 and (is_apart if within else received > 0), figures)

            yield judge


def _actor(*words: object, within: Sequence[str] = ()) -> Helper:
    return Helper(*within, sys.executable, "-m", "benchmarks.pressure.actors", *words)


def _shared_ports() -> int:
    """What changes when Fast DDS makes one of its ports in shared memory anew."""
    with os.scandir(SHARED_MEMORY) as files:
        return hash(frozenset(file.inode() for file in files if file.name.startswith("fastrtps_port")))


def subscriber(_: Pressed) -> AbstractContextManager[Judge]:
    return _subscribed()


def second_router(_: Pressed) -> AbstractContextManager[Judge]:
    """The subscriber is in a container, as far as shared memory goes; it gets nothing, then. Takes a privilege."""
    mount = f'mount -t tmpfs -o size=8m tmpfs {SHARED_MEMORY} && exec "$@"'
    return _subscribed("unshare", "--mount", "sh", "-c", mount, "sh")


@contextmanager
def http(pressed: Pressed) -> Iterator[Judge]:
    port = pressed.place.metrics
    words = ("--attack", "unread", "--port", port, "--clients", CLIENTS)
    with Helper(sys.executable, "-m", "benchmarks.http_flood", *words) as flood:
        deadline = time.monotonic() + 20
        while _connections(port) < FEWEST_CLIENTS and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(SETTLE_SECONDS)
        with _repeated(0.1, lambda: _connections(port)) as connections:

            def judge(_: float) -> Proof:
                mean = sum(connections) / max(1, len(connections))
                return Proof(flood.is_running() and mean >= FEWEST_CLIENTS, {"clients_connected": round(mean, 1)})

            yield judge


def _connections(port: int) -> int:
    """Established ones that a local port has accepted or will."""
    rows = [line.split() for line in read("/proc/net/tcp").splitlines()[1:]]
    return sum(int(row[1].rpartition(":")[2], 16) == port and row[3] == "01" for row in rows)


@contextmanager
def images(pressed: Pressed) -> Iterator[Judge]:
    with _actor("camera") as camera:
        camera.result()
        with _actor("viewer", pressed.place.websocket) as viewer:
            viewer.result()
            deadline = time.monotonic() + 20
            while not viewer.ask()["count"] and time.monotonic() < deadline:
                time.sleep(0.2)
            camera.ask()

            def judge(seconds: float) -> Proof:
                published, got = camera.ask()["count"] / seconds, viewer.ask()["count"] / seconds
                return Proof(got >= 1, {"images_hz": round(published, 2), "images_to_client_hz": round(got, 2)})

            yield judge


@contextmanager
def reloads(pressed: Pressed) -> Iterator[Judge]:
    place, pid = pressed.place, _listening(pressed)
    done = scrape(place.metrics, "router_config_reloads_total", 'result="ok"')
    number = 0

    def reload() -> int:
        nonlocal number
        number += 1
        place.table.write_text(table(place, "reloads", is_changed=number % 2 == 1))
        os.utime(place.table, (time.time() - 60,) * 2)  # or the reload waits until it rests
        os.kill(pid, signal.SIGHUP)
        return number

    with _repeated(RELOAD_SECONDS, reload) as asked:

        def judge(seconds: float) -> Proof:
            taken = scrape(place.metrics, "router_config_reloads_total", 'result="ok"') - done
            return Proof(taken >= seconds / 4, {"reloads": taken, "reloads_asked": len(asked)})

        yield judge


def _listening(pressed: Pressed) -> int:
    """The process that has the router's port open: where its command is wrapped, not the one that was started."""
    for pid in pressed.subject.pids():
        for descriptor in Path(f"/proc/{pid}/fd").glob("*"):
            if descriptor.is_symlink() and str(descriptor.readlink()) in pressed.subject.sockets():
                return pid
    sys.exit("no process of the router has its port open")


@contextmanager
def recording(pressed: Pressed) -> Iterator[Judge]:
    place = pressed.place
    url = f"http://127.0.0.1:{place.metrics}"

    def save() -> int:
        return len(post(url, "/record/save", 30).body)

    with _repeated(SAVE_SECONDS, save) as saved:

        def judge(seconds: float) -> Proof:
            files = [path.stat().st_size for path in place.recordings.glob("*_http.mcap")]
            figures = {"saves": len(saved), "largest_mb": round(max(files, default=0) / 1e6, 2)}
            return Proof(len(files) >= seconds / SAVE_SECONDS / 3, figures)

        yield judge


@contextmanager
def busy(_: Pressed) -> Iterator[Judge]:
    with helpers.busy() as children:
        before = sum(_cpu_seconds(child.pid) for child in children)

        def judge(seconds: float) -> Proof:
            used = (sum(_cpu_seconds(child.pid) for child in children) - before) / seconds
            return Proof(used >= BUSY_CORES, {"busy_cores": round(used, 2)})

        yield judge


def _cpu_seconds(pid: int) -> float:
    return int((read(f"/proc/{pid}/schedstat") or "0").split()[0]) / 1e9


@dataclass(frozen=True)
class Pressure:
    """`title`: what it is. `for_routers`: whether it needs what only a router has. `before`: datagrams sent before."""

    name: str
    title: str
    press: Callable[[Pressed], AbstractContextManager[Judge]]
    for_routers: bool = False
    before: int = 0


PRESSURES = (
    Pressure("alone", "nothing else", alone),
    Pressure("subscriber", "a subscriber of all topics", subscriber),
    Pressure("second-router", "a subscriber with a /dev/shm of its own, as in a container", second_router),
    Pressure("http", f"{CLIENTS} HTTP clients that send requests and do not read", http, for_routers=True),
    Pressure("images", "images of 2 MB through a gateway", images, for_routers=True),
    Pressure("reloads", f"another table every {RELOAD_SECONDS} s", reloads, for_routers=True),
    Pressure("recording", "a saved minute every second", recording, for_routers=True, before=PREFILLED),
    Pressure("busy", f"{helpers.BUSY} busy processes on both cores", busy),
)


def metrics(port: int) -> dict[str, float]:
    """All that the router's /metrics has; asked again while others keep it busy."""
    deadline = time.monotonic() + 20
    while True:
        try:
            url = f"http://127.0.0.1:{port}/metrics"
            with urllib.request.urlopen(url, timeout=5) as answer:
                text = answer.read().decode()
            break
        except OSError:
            if time.monotonic() > deadline:
                sys.exit(f"nobody answers on port {port}")
            time.sleep(0.1)
    lines = (line.rpartition(" ") for line in text.splitlines() if line and line[0] != "#")
    return {series: float(value) for series, _, value in lines}


def scrape(port: int, metric: str, *labels: str) -> float:
    return total(metrics(port), metric, *labels)


def total(values: dict[str, float], metric: str, *labels: str) -> float:
    """Of all series of a metric that have these labels, each as in `reason="stale"`."""
    return sum(
        value
        for series, value in values.items()
        if series.partition("{")[0] == metric and all(label in series for label in labels)
    )


@contextmanager
def _repeated(period: float, act: Callable[[], int]) -> Iterator[list[int]]:
    """Acts again and again in a thread, `period` s apart; the list gets what that returned. Failures count nothing."""
    ended, results = threading.Event(), list[int]()

    def run() -> None:
        while not ended.wait(period):
            try:
                results.append(act())
            except (OSError, RouterError) as error:
                print(f"  {error}", file=sys.stderr)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield results
    finally:
        ended.set()
        thread.join()

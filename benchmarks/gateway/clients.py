"""What clients of a gateway cost the router: an open page while datagrams arrive, and large images for several clients.

    python -m benchmarks.gateway.clients page --rate 1000
    python -m benchmarks.gateway.clients images

Each line is a fresh process: with and without clients, in turns. `--threads` also prints the CPU of each thread.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from benchmarks.versus.building import build
from benchmarks.versus.contenders import TABLES, Ports, Router
from benchmarks.versus.helpers import load, sink
from benchmarks.versus.processes import cores, read, spawn
from benchmarks.versus.subject import Meter, Subject
from tests.ports import free_port

GATEWAY = """\
  page:
    transport: {{websocket: 127.0.0.1:{port}}}
    publish_period: {period}
    max_clients_per_host: 100
    max_message: 64MiB
    topics: {{include: {topics}}}
"""
PAGE = """\
version: 1
extends: {base}
http: {{address: "127.0.0.1:${{METRICS_PORT}}"}}
gateways:
"""
IMAGES = """\
version: 1
http: {{address: "127.0.0.1:${{METRICS_PORT}}"}}
gateways:
"""
SETTLE = 6.0
CLIENT = """\
import sys
from websockets.sync.client import connect
with connect(sys.argv[1], max_size=None, proxy=None, compression=None) as gateway:
    for _ in gateway:
        pass
"""
CAMERA = """\
import os, sys, time, rclpy
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("camera")
publisher = node.create_publisher(Image, "camera", 1)
images = [Image(height=1000, width=2000, step=6000, encoding="rgb8", data=os.urandom(6_000_000)) for _ in range(2)]
while True:
    for image in images:
        publisher.publish(image)
        time.sleep(0.2)
"""


def wait_until_open(subject: Subject, port: int) -> None:
    deadline = time.monotonic() + 60
    while True:
        subject.check(deadline)
        with socket.socket() as caller:
            if caller.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)


@contextmanager
def clients(port: int, number: int) -> Iterator[None]:
    """Open websockets that are read."""
    with ExitStack() as opened:
        for _ in range(number):
            process = spawn([sys.executable, "-c", CLIENT, f"ws://127.0.0.1:{port}/"], cores().helpers)
            opened.callback(process.wait)
            opened.callback(process.kill)
        yield
        time.sleep(0.1)


def threads(subject: Subject) -> Counter[str]:
    """The CPU time (ns) of the threads, by name."""
    found: Counter[str] = Counter()
    for task in (path for pid in subject.pids() for path in Path(f"/proc/{pid}/task").glob("*")):
        found[read(task / "comm").strip()] += int((read(task / "schedstat") or "0").split()[0])
    return found


def show_threads(before: Counter[str], after: Counter[str], events: float) -> None:
    for name, spent in (after - before).most_common(8):
        print(f"    {name:16}{spent / 1e3 / events:8.2f} us")


def page(args: argparse.Namespace, number: int, folder: Path) -> float:
    """CPU microseconds per datagram."""
    port, ports = free_port(), Ports.free()
    table = folder / "page.yaml"
    text = PAGE.format(base=TABLES / "own.yaml") + GATEWAY.format(port=port, period="200ms", topics='["/**"]')
    table.write_text(text, encoding="utf-8")
    with Subject(Router("page", table), ports, folder / "log") as subject, sink(ports.first):
        subject.wait_until_bound()
        wait_until_open(subject, port)
        with clients(port, number):
            time.sleep(SETTLE)
            with load(ports.listen[:1], args.rate, args.seconds + 2) as generator:
                time.sleep(1)
                meter, before, began = Meter(subject), threads(subject), time.monotonic()
                time.sleep(args.seconds)
                meter.read()
                after, elapsed = threads(subject), time.monotonic() - began
                datagrams = float(generator.result()["rate"]) * elapsed
    if args.threads:
        show_threads(before, after, datagrams)
    return meter.cpu_ns / 1e3 / datagrams


def images(args: argparse.Namespace, number: int, folder: Path) -> tuple[float, float]:
    """CPU in percent of a core, and the most memory in MB."""
    port, ports = free_port(), Ports.free()
    table = folder / "images.yaml"
    text = IMAGES + GATEWAY.format(port=port, period="200ms", topics="[/camera]")
    table.write_text(text, encoding="utf-8")
    with Subject(Router("images", table, listens=False), ports, folder / "log") as subject:
        camera = spawn([sys.executable, "-c", CAMERA], cores().helpers)
        try:
            wait_until_open(subject, port)
            time.sleep(2)
            with clients(port, number):
                time.sleep(SETTLE)
                meter, before, began = Meter(subject), threads(subject), time.monotonic()
                memory = []
                while time.monotonic() < began + args.seconds:
                    memory.append(subject.rss_mb())
                    time.sleep(0.05)
                meter.read()
                elapsed = time.monotonic() - began
                if args.threads:
                    show_threads(before, threads(subject), elapsed)
        finally:
            camera.kill()
            camera.wait()
    return meter.cpu_ns / elapsed / 1e7, max(memory)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gateway.clients", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("scenario", choices=["page", "images"])
    parser.add_argument("--rate", type=float, default=1000, help="datagrams per second (default: %(default)g)")
    parser.add_argument("--seconds", type=float, default=6, help="of one measurement (default: %(default)g)")
    parser.add_argument("--repeat", type=int, default=3, help="fresh processes of each (default: %(default)s)")
    parser.add_argument("--clients", type=int, action="append", help="numbers of clients")
    parser.add_argument("--threads", action="store_true", help="also print the CPU of each thread")
    args = parser.parse_args()
    build()
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.sched_setaffinity(0, {cores().helpers})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder
        for _ in range(args.repeat):
            for number in args.clients or ([0, 1] if args.scenario == "page" else [0, 10]):
                if args.scenario == "page":
                    print(f"{number} clients {page(args, number, Path(folder)):.2f} us per datagram", flush=True)
                else:
                    cpu, memory = images(args, number, Path(folder))
                    print(f"{number} clients {cpu:.1f} % {memory:.0f} MB", flush=True)


if __name__ == "__main__":
    main()

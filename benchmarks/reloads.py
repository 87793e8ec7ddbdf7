"""A thousand reloads of a running router under load: are all datagrams routed once and in order, does memory stay flat?

    python benchmarks/reloads.py [--reloads 1000] [--rate 2000] [--table routes/rover.yaml]

The router is a process of its own. Its table is TABLE with loopback addresses; every other reload adds a listener, a
destination and a topic to the route of `imu_info`, and takes them away again. Exit code 1 where something is wrong.
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, cast

from router.compiler import check_table
from router.table.model import RouteTable
from router.tools.running_router import post

ROOT = Path(__file__).resolve().parent.parent
IMU = bytes.fromhex(
    "6a310d8fc2f53d1552b89ebe1dd7a31c41256f12833b2d583934bc35355e3a3e3d33339b4145cdcc6cc04d6666304268017001"
)
COUNTED = slice(3, 7)
"""The first field of the message, a float: each datagram has another number in it."""

TABLE = """\
version: 1
extends: {table}
http: {{address: "127.0.0.1:{metrics}"}}
foxglove: {{address: "127.0.0.1:{foxglove}"}}
record: {{directory: {folder}, last: 1s}}
gateways: {{dashboard: {{ignore: this is about routes}}}}
listen:
  rover: {{address: "127.0.0.5:{listen}"}}
{listener}endpoints:
{endpoints}{route}"""
ROUTE = """\
routes:
  imu_info:
    source: sensor_board
    destinations: [basestation, {other}]
    topics: [{{topic: imu_two, type: sensor_msgs/msg/Imu, queue_depth: 7, fields: {{header.frame_id: "'imu'"}}}}]
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--reloads", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=2000.0, help="datagrams per second")
    parser.add_argument("--table", type=Path, default=ROOT / "routes" / "rover.yaml")
    args = parser.parse_args()
    with ExitStack() as opening:
        folder = Path(opening.enter_context(tempfile.TemporaryDirectory()))
        endpoints = {name: opening.enter_context(udp(f"127.0.0.{40 + n}")) for n, name in enumerate(names(args.table))}
        tables = two_tables(args.table, folder, endpoints)
        path = folder / "table.yaml"
        path.write_text(tables[0])
        router = opening.enter_context(running(path))
        numbers = Numbers(endpoints["basestation"])
        sending = Sending(endpoints["sensor_board"], (router.host, router.port), args.rate)
        memory, took = [], []
        for number in range(args.reloads):
            path.write_text(tables[1 - number % 2])
            os.utime(path, (time.time() - 60,) * 2)  # or the reload waits until it rests
            began = time.monotonic()
            router.reload()
            took.append(time.monotonic() - began)
            if number % max(1, args.reloads // 20) == 0:
                memory.append(router.memory_kb())
                print(f"{number:5} reloads: {memory[-1] / 1024:.1f} MiB, {took[-1] * 1000:.0f} ms", flush=True)
        sent = sending.stop()
        received = numbers.stop(sent)
        counted = router.counted("router_datagrams_received_total")
    quarter = max(1, len(memory) // 4)
    early, late = statistics.mean(memory[quarter : 2 * quarter]), statistics.mean(memory[-quarter:])
    growth = late / early - 1
    right = received == list(range(sent)) and counted == sent
    print(f"sent {sent}, the router counted {counted}, the basestation got {len(received)}, in order: {right}")
    print(f"a reload took {sorted(took)[len(took) // 2] * 1000:.0f} ms (median), {max(took) * 1000:.0f} ms at most")
    print(f"memory in the second quarter {early / 1024:.1f} MiB, in the last one {late / 1024:.1f} ({growth:+.1%})")
    return 0 if right and growth < 0.05 else 1


def names(table: Path) -> list[str]:
    """Of the endpoints."""
    return list(read(table).endpoints)


def read(path: Path) -> RouteTable:
    found = check_table(path).table
    if found is None:
        raise SystemExit(f"{path} cannot be read")
    return found


def two_tables(table: Path, folder: Path, endpoints: Mapping[str, socket.socket]) -> tuple[str, str]:
    known = read(table)
    lines = "".join(
        f'  {name}: {{address: "{opened.getsockname()[0]}:{opened.getsockname()[1]}", '
        f"kind: {known.endpoints[name].kind.value}}}\n"
        for name, opened in endpoints.items()
    )
    listen, second, metrics, foxglove = (free_port(kind) for kind in (2, 2, 1, 1))
    other = next(name for name in endpoints if name not in ("sensor_board", "basestation"))
    common = {
        "table": table.resolve(),
        "metrics": metrics,
        "foxglove": foxglove,
        "folder": folder / "recordings",
        "listen": listen,
        "endpoints": lines,
    }
    listener = f'  second: {{address: "127.0.0.5:{second}"}}\n'
    return (
        TABLE.format(**common, listener="", route=""),
        TABLE.format(**common, listener=listener, route=ROUTE.format(other=other)),
    )


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def udp(host: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        opened.bind((host, 0))
        yield opened


class RunningRouter:
    def __init__(self, process: subprocess.Popen[str], path: Path) -> None:
        table = read(path)
        self._pid = process.pid
        self._url = f"http://{table.http.address.value if table.http else ''}"
        self.host, self.port = table.listeners["rover"].address.value

    def reload(self) -> None:
        answer = post(self._url, "/-/reload", 60)
        if not answer.ok:
            raise SystemExit(f"a reload failed: {answer.body}")

    def memory_kb(self) -> int:
        """Resident, of this process alone."""
        rollup = Path(f"/proc/{self._pid}/smaps_rollup").read_text()
        return int(next(line.split()[1] for line in rollup.splitlines() if line.startswith("Private_Dirty")))

    def counted(self, name: str) -> int:
        with urllib.request.urlopen(f"{self._url}/metrics", timeout=60) as answer:  # noqa: S310 - our own address
            text = answer.read().decode()
        return sum(int(float(line.split()[-1])) for line in text.splitlines() if line.startswith(name))


@contextmanager
def running(path: Path) -> Iterator[RunningRouter]:
    command = [sys.executable, "-m", "router", "run", "--log-level", "info", str(path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    log = cast("IO[str]", process.stderr)
    try:
        if not any('"router started"' in line for line in log):
            raise SystemExit("the router did not start")
        threading.Thread(target=log.read, daemon=True).start()
        yield RunningRouter(process, path)
    finally:
        process.terminate()
        process.wait(30)


class Sending:
    """Numbered datagrams, four at a time."""

    def __init__(self, board: socket.socket, to: tuple[str, int], rate: float) -> None:
        self._ended = threading.Event()
        self._sent = 0
        self._thread = threading.Thread(target=self._run, args=(board, to, 4 / rate))
        self._thread.start()

    def _run(self, board: socket.socket, to: tuple[str, int], pause: float) -> None:
        due = time.monotonic()
        while not self._ended.wait(max(0.0, due - time.monotonic())):
            due += pause
            for _ in range(4):
                datagram = bytearray(IMU)
                datagram[COUNTED] = self._sent.to_bytes(4, "little")
                board.sendto(datagram, to)
                self._sent += 1

    def stop(self) -> int:
        self._ended.set()
        self._thread.join()
        return self._sent


class Numbers:
    """What arrives."""

    def __init__(self, basestation: socket.socket) -> None:
        self._socket = basestation
        self._socket.settimeout(1.0)
        self._numbers: list[int] = []
        self._sent: int | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while self._sent is None or len(self._numbers) < self._sent:
            try:
                self._numbers.append(int.from_bytes(self._socket.recv(2048)[COUNTED], "little"))
            except TimeoutError:
                if self._sent is not None:
                    return

    def stop(self, sent: int) -> list[int]:
        self._sent = sent
        self._thread.join()
        return self._numbers


if __name__ == "__main__":
    sys.exit(main())

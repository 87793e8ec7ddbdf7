"""What a connected `router tap`, and an open status page, cost a router that has 5,000 datagrams per second to route.

    python -m benchmarks.taps --rate 5000 --seconds 6

One router gets datagrams of four of the rover's routes without end, and records nothing. In turns nobody looks,
somebody taps everything, somebody taps one payload case, and somebody has the status page open. Prints the router's
processor time in each, and its ratio to that of the turns beside it in which nobody looked. Exits 1 above --most, or if
a datagram was lost to the kernel. All on the loopback interface.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from statistics import median

# Before anything imports rclpy.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from tests.acceptance.payloads import generated
from tests.acceptance.rover_map import FLOWS
from tests.acceptance.site import ROOT, RouterProcess, Site, site, total

TICK = 0.002
"""Seconds between two bursts of the sender."""

CASES = ("imu_info", "gps_info", "drive_diag", "arm_pos")
TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen:
  rover: {{address: 127.0.0.5:{listen}, framing: zero_trimmed, receive_buffer: 4MiB}}
endpoints:
{endpoints}routes:
  imu_info:
    source: sensor_board
    destinations: [basestation]
    topics: [{{topic: imu_data, type: comms/msg/ImuSensorInformation, queue_depth: 10, fields: auto}}]
  gps_info:
    source: sensor_board
    destinations: [basestation]
    topics: [{{topic: gps_data, type: comms/msg/SensorBoardGPSInfo, queue_depth: 10, fields: auto}}]
  drive_diag:
    source: driving_board
    destinations: [basestation]
    topics: [{{topic: drive_diag, type: comms/msg/DrivingBoardDiagnostics, queue_depth: 10, fields: auto}}]
  arm_pos:
    source: arm_board
    destinations: [basestation]
    topics: [{{topic: arm_pos, type: comms/msg/ArmBoardActualPositions, queue_depth: 10, fields: auto}}]
"""
"""The rover's routes of CASES. The rover's own table records its last minute, for which the mirror runs already."""

WARM_UP = 1.0


class Load:
    """Sends in a thread of its own until closed."""

    def __init__(self, place: Site, rate: float) -> None:
        self._datagrams = [(FLOWS[case].source, next(generated(case)).datagram) for case in CASES]
        self._place = place
        self._each_tick = max(1, round(rate * TICK))
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _send(self) -> None:
        due, number = time.monotonic(), 0
        while not self._closed.is_set():
            for _ in range(self._each_tick):
                self._place.send(*self._datagrams[number % len(self._datagrams)])
                number += 1
            due += TICK
            time.sleep(max(0.0, due - time.monotonic()))


def tapping(*words: str) -> Callable[[Site], AbstractContextManager[None]]:
    @contextmanager
    def somebody(place: Site) -> Iterator[None]:
        command = [sys.executable, "-m", "router", "tap", *words, "--table", str(place.folder / "table.yaml")]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
            if process.stderr is None or not process.stderr.readline().startswith(b"tapping "):
                raise RuntimeError("no tap")
            yield
            process.terminate()

    return somebody


@contextmanager
def with_page(place: Site) -> Iterator[None]:
    closed = threading.Event()

    def ask() -> None:
        while not closed.wait(1.0):
            with urllib.request.urlopen(f"http://127.0.0.1:{place.metrics}/status.json", timeout=5) as answer:
                answer.read()

    asking = threading.Thread(target=ask)
    asking.start()
    yield
    closed.set()
    asking.join()


LOOKING: dict[str, Callable[[Site], AbstractContextManager[None]]] = {
    "tap": tapping(),
    "tap one case": tapping("gps_info"),
    "status page": with_page,
}


def processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(place: Site, pid: int, seconds: float) -> tuple[float, float]:
    """Processor seconds per datagram, and datagrams per second."""
    counts, cpu, begin = place.scrape(), processor_seconds(pid), time.monotonic()
    time.sleep(seconds)
    spent, passed = processor_seconds(pid) - cpu, time.monotonic() - begin
    received = total(place.changes(counts), "datagrams_received")
    return spent / received, received / passed


def run(rate: float, seconds: float, turns: int, most: float) -> bool:
    ratios: dict[str, list[float]] = {name: [] for name in LOOKING}
    with (
        tempfile.TemporaryDirectory() as folder,
        site(Path(folder)) as place,
        RouterProcess(Path(folder), place.table(TABLE)) as router,
        closing(Load(place, rate)),
    ):
        time.sleep(WARM_UP)
        before, _ = measured(place, router.process.pid, seconds)
        for _ in range(turns):
            for name, somebody in LOOKING.items():
                with somebody(place):
                    time.sleep(WARM_UP)
                    looked_at, arrived = measured(place, router.process.pid, seconds)
                time.sleep(WARM_UP)
                after, _ = measured(place, router.process.pid, seconds)
                ratios[name].append(looked_at / ((before + after) / 2))
                costs = f"{before * 1e6:6.1f} us  {looked_at * 1e6:6.1f} us  {ratios[name][-1]:5.2f}"
                print(f"{name:14}{arrived:8.0f}/s  {costs}", flush=True)
                before = after
        lost = total(place.scrape(), "kernel_drops")
    for name, found in ratios.items():
        print(f"{name:14} median {median(found):5.2f}")
    print(f"{lost} lost to the kernel")
    return lost == 0 and max(map(median, ratios.values())) <= most


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rate", type=float, default=5000, help="datagrams per second; default 5000")
    parser.add_argument("--seconds", type=float, default=6, help="of each turn; default 6")
    parser.add_argument("--turns", type=int, default=3, help="default 3")
    parser.add_argument("--most", type=float, default=1.15, help="the highest ratio that is good enough; default 1.15")
    arguments = parser.parse_args()
    return 0 if run(arguments.rate, arguments.seconds, arguments.turns, arguments.most) else 1


if __name__ == "__main__":
    sys.exit(main())

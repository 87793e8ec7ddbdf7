"""What `max_rate` and `bandwidth` let through over ten seconds, at several input rates.

    python -m benchmarks.rates --seconds 10

One stream goes to three destinations: to two of them at most 30 times a second (`on_limit: first` and
`on_limit: latest`), to the third with a bandwidth. Each input rate has a router of its own.
Exits 1 if a rate was missed by more than 1 Hz, or a bandwidth overdrawn, or not used up while there was enough to send.
All on the loopback interface.
"""

from __future__ import annotations

import argparse
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import HOSTS
from tests.acceptance.site import ROOT, RouterProcess, site
from tests.oracles.held_back import BURST

NS = 1_000_000_000
INPUT_HERTZ = (20, 29, 31, 45, 100, 500, 2000)
DESTINATIONS = ("first", "latest", "link")
MAX_RATE = 30
BUDGET = 10_000
"""In bytes per second. Both are those of the tables below."""

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
    destinations:
      - {{endpoint: first, max_rate: 30 Hz}}
      - {{endpoint: latest, max_rate: 30 Hz, on_limit: latest}}
      - link
"""
WITH_BUDGET = """\
version: 1
extends: table.yaml
endpoints: {link: {bandwidth: 10kB/s}}
"""
FIELDS = "accel_x=1.5 accel_y=1.5 accel_z=1.5 gyro_x=1.5 gyro_y=1.5 gyro_z=1.5"


@dataclass
class Arrivals:
    """When datagrams came (monotonic, ns), in order, and how long each was."""

    times: list[int]
    sizes: list[int]

    def until(self, end: int) -> Arrivals:
        number = bisect_left(self.times, end)
        return Arrivals(self.times[:number], self.sizes[:number])

    def in_any_second(self) -> tuple[int, int]:
        """The fewest and the most that came within one second, of all seconds that begin with an arrival."""
        whole = [time for time in self.times if time + NS <= self.times[-1]]
        found = [bisect_left(self.times, time + NS) - index for index, time in enumerate(whole)]
        return min(found), max(found)


def received(sockets: Mapping[str, socket.socket], sender: subprocess.Popen[bytes]) -> dict[str, Arrivals]:
    """All that comes while the sender runs."""
    arrivals = {name: Arrivals([], []) for name in sockets}
    with selectors.DefaultSelector() as selector:
        for name, opened in sockets.items():
            selector.register(opened, selectors.EVENT_READ, (opened, arrivals[name]))
        while sender.poll() is None:
            for key, _ in selector.select(0.1):
                opened, there = key.data
                there.sizes.append(len(opened.recv(2048)))
                there.times.append(time.monotonic_ns())
    return arrivals


def measure(hertz: int, seconds: int, folder: Path) -> dict[str, Arrivals]:
    """What came to each destination in so many seconds from the first datagram on."""
    hosts = {"sensor_board": HOSTS["sensor_board"]} | dict.fromkeys(DESTINATIONS, HOSTS["basestation"])
    with site(folder, hosts) as place:
        place.table(TABLE)
        table = folder / "bandwidth.yaml"
        table.write_text(WITH_BUDGET)
        with RouterProcess(folder, table):
            # A second longer than what is measured.
            rate = f"--rate {hertz}Hz --count {hertz * (seconds + 1)}"
            words = f"send imu_info {FIELDS} --table {table} --to rover --from {hosts['sensor_board']} {rate}"
            sender = subprocess.Popen(
                [sys.executable, "-m", "router", *words.split()], cwd=ROOT, stdout=subprocess.DEVNULL
            )
            arrivals = received({name: place.endpoints[name] for name in DESTINATIONS}, sender)
            if sender.wait(PATIENCE):
                raise RuntimeError(f"router send ended with {sender.returncode}")
    return {name: there.until(there.times[0] + seconds * NS) for name, there in arrivals.items()}


def show(hertz: int, seconds: int, arrivals: Mapping[str, Arrivals]) -> bool:
    """Prints one line of the table. Whether everything was kept to."""
    shown, kept = f"{hertz:6}", True
    for name in ("first", "latest"):
        rate = len(arrivals[name].times) / seconds
        fewest, most = arrivals[name].in_any_second()
        shown += f"{rate:12.1f} {f'({fewest} to {most})':12}"
        kept = kept and abs(rate - min(hertz, MAX_RATE)) <= 1
    link = arrivals["link"]
    size = max(link.sizes)
    asked, sent = hertz * size, sum(link.sizes) / seconds
    burst = BUDGET * BURST / NS + size
    print(f"{shown}{asked:12} {sent:12.0f}")
    return kept and 0.99 * min(asked, BUDGET) - size / seconds <= sent <= BUDGET + burst / seconds


def run(seconds: int, rates: Sequence[int]) -> bool:
    print(f"Over {seconds} s: datagrams/s with `max_rate: {MAX_RATE} Hz`, and in any one second; bytes/s of {BUDGET}")
    print(f"{'input':>6}{'first':>12}{'':13}{'latest':>12}{'':13}{'asked':>12} {'sent':>12}")
    kept = []
    for hertz in rates:
        with tempfile.TemporaryDirectory() as folder:
            kept.append(show(hertz, seconds, measure(hertz, seconds, Path(folder))))
    return all(kept)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=int, default=10, help="for each input rate, at least 2; default 10")
    arguments = parser.parse_args()
    if arguments.seconds < 2:
        parser.error("--seconds: a rate is counted in each whole second, so at least 2")
    return 0 if run(arguments.seconds, INPUT_HERTZ) else 1


if __name__ == "__main__":
    sys.exit(main())

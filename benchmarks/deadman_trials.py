"""How long a board drives on when its commands stop: a router under load, its command sources killed, stopped, cut off.

    python -m benchmarks.deadman_trials --trials 100 [--rate 20000] [--churn]

Two 50 Hz sources, one on UDP and one on ROS, each with a board of its own, while another process sends 20,000
datagrams a second through the router. With --churn five subscribers of what these are published to are killed and
started again all the time. Times are those at which the kernel got the datagrams: from a board's last command to its
first brake. Exits 1 if one was late or a stale command was sent. All on the loopback interface.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

# Before anything imports rclpy.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from benchmarks.deadman_actors import Arrival, Board, Churn, Proxy, Source, child
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import HOSTS, ROUTER
from tests.acceptance.site import RouterProcess, site, total

MS = 1_000_000
TIMEOUT, REPEAT = 500 * MS, 100 * MS
TTL = 200
"""ms; a command that takes 50 ms longer to the board was sent too late."""

PAUSE = 2.0
"""Seconds for which a source, or the router, is stopped."""

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
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 200ms
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], repeat: 100ms}}
  drive_motor:
    source: {{topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage, queue_depth: 10}}
    fields: auto
    destinations: [arm_board]
    ttl: 200ms
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}, to: [arm_board], repeat: 100ms}}
"""


@dataclass
class Result:
    """Of all trials of one source and fault. `delays` are ns from the last command to the first brake.

    A router that was stopped brakes when it goes on: such trials have no delay, and only look for stale commands.
    """

    delays: list[int] = field(default_factory=list)
    trials: int = 0
    stale: int = 0

    @property
    def late(self) -> int:
        return sum(delay > TIMEOUT + REPEAT for delay in self.delays)


def attempt(board: Board, source: Source, fault: str, result: Result, noise: random.Random) -> None:
    """One trial: commands for a while, the fault, the brake and its repeats, and commands again."""
    arrivals = [*_commands(board), *board.arrivals(noise.uniform(0.1, 0.2))]
    source.fail(fault)
    while arrivals[-1].made is not None:
        arrivals.append(board.next())
    result.trials += 1
    result.delays.append(arrivals[-1].at - arrivals[-2].at)
    repeats = list(board.arrivals(PAUSE if fault == "stopped" else 3 * REPEAT / 1e9))
    if len(repeats) < 2 or any(arrival.made is not None for arrival in repeats):
        raise RuntimeError(f"brakes are not repeated, or commands come although their source was {fault}: {repeats}")
    source.recover(fault)
    result.stale += _stale([*arrivals, *_commands(board)])


def _commands(board: Board) -> list[Arrival]:
    """Waits until commands come, and not brakes; what came meanwhile."""
    arrivals: list[Arrival] = []
    deadline = time.monotonic() + PATIENCE
    while len(arrivals) < 5 or any(arrival.made is None for arrival in arrivals[-5:]):
        arrivals.append(board.next())
        if time.monotonic() > deadline:
            raise RuntimeError("the commands never came")
    return arrivals


def pause(router: RouterProcess) -> None:
    """Stops the router for a while, in which commands and flood go on."""
    router.process.send_signal(signal.SIGSTOP)
    time.sleep(PAUSE)
    router.process.send_signal(signal.SIGCONT)
    time.sleep(0.5)


def _stale(arrivals: Iterable[Arrival]) -> int:
    return sum(arrival.is_older_than(TTL + 50) for arrival in arrivals)


def run(trials: int, rate: int, is_churning: bool, folder: Path) -> dict[tuple[str, str], Result]:
    noise = random.Random(1)
    with ExitStack() as opened:
        hosts = {name: HOSTS[name] for name in ("sensor_board", "driving_board", "arm_board", "basestation")}
        place = opened.enter_context(site(folder, hosts))
        table, router_address = place.table(TABLE), (ROUTER, place.listen)
        boards = {
            "UDP": Board(place.endpoints["driving_board"], table),
            "ROS": Board(place.endpoints["arm_board"], table),
        }
        router = opened.enter_context(RouterProcess(folder, table))
        proxy = opened.enter_context(closing(Proxy(place.endpoints["basestation"], router_address)))
        sources = {
            "UDP": opened.enter_context(closing(Source(("udp", str(table), proxy.address), proxy))),
            "ROS": opened.enter_context(closing(Source(("ros", "drive_motor"), None))),
        }
        flood = child("flood", str(table), "{}:{}".format(*router_address), hosts["sensor_board"], str(rate))
        opened.callback(flood.wait)
        opened.callback(flood.kill)
        place.receive("basestation")  # the flood has begun
        if is_churning:
            opened.enter_context(closing(Churn("imu_data")))
        results = {(name, fault): Result() for name in sources for fault in Source.FAULTS}
        before, begun = place.scrape(), time.monotonic()
        for name, source in sources.items():
            for fault in itertools.islice(itertools.cycle(Source.FAULTS), trials):
                attempt(boards[name], source, fault, results[name, fault], noise)
        counted, lasted = place.changes(before), time.monotonic() - begun
        taken, lost = (total(counted, metric) / lasted for metric in ("datagrams_received", "kernel_drops"))
        print(f"{taken:.0f} datagrams/s were received meanwhile, and {lost:.0f}/s dropped by the kernel")
        before = place.scrape()
        for _ in range(trials // 10):
            pause(router)
        for name, route in {"UDP": "manual_drive", "ROS": "drive_motor"}.items():
            results[name, "router stopped"] = Result(trials=trials // 10, stale=_stale(boards[name].arrivals(0)))
            dropped = total(place.changes(before), "messages_dropped", route=route, reason="stale")
            print(f"{dropped} commands of {name} were dropped as stale when the router went on after {PAUSE} s")
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=100, help="of each source, the faults by turns; default 100")
    parser.add_argument("--rate", type=int, default=20_000, help="datagrams per second beside them; default 20000")
    parser.add_argument("--churn", action="store_true", help="kill and restart subscribers meanwhile")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        results = run(arguments.trials, arguments.rate, arguments.churn, Path(folder))
    print(f"ms from the last command to the first brake; late is beyond {(TIMEOUT + REPEAT) // MS}")
    print(f"{'source':8}{'fault':16}{'trials':>8}{'min':>9}{'median':>9}{'max':>9}{'late':>6}{'stale':>7}")
    for (source, fault), result in results.items():
        delays = [delay / MS for delay in result.delays]
        shown = [f"{f(delays):9.1f}" if delays else f"{'-':>9}" for f in (min, statistics.median, max)]
        print(f"{source:8}{fault:16}{result.trials:8}{''.join(shown)}{result.late:6}{result.stale:7}")
    return 1 if any(result.late or result.stale for result in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())

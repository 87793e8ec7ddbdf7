"""What recording costs: CPU of a router that records beside one that does not, under the same load.

    python -m benchmarks.recording
    python -m benchmarks.recording --rate 1000 --repeat 5

Each router is a fresh process, in turns. `forward` does the least for a datagram, so that whatever else is done weighs
most; `topics` publishes to ROS, and one process subscribes. `memory` keeps the last 60 s only, `tap` is a recording
that another process makes, or whatever else has the router's tap open.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.versus.building import build
from benchmarks.versus.contenders import TABLES, Router
from benchmarks.versus.helpers import ALL_TOPICS
from benchmarks.versus.processes import cores, spawn
from benchmarks.versus.runs import Traffic, run, warm_up
from benchmarks.versus.subject import Subject
from benchmarks.versus.subscriber import subscribed
from benchmarks.versus.trial import Pace, Trial

WORKS = {"forward": "forward.yaml", "topics": "rover.yaml"}
CONDITIONS = {
    "none": "",
    "recording": "record: {directory: recordings}\n",
    "memory": "record: {directory: recordings, continuous: false, last: 60s}\n",
    "tap": "",
}
TABLE = """\
version: 1
extends: {base}
http: {{address: "127.0.0.1:${{METRICS_PORT}}"}}
{record}"""


@contextmanager
def tapped(subject: Subject, is_wanted: bool) -> Iterator[None]:
    """Somebody reads the tap, where that is wanted, and does nothing with it."""
    if not is_wanted:
        yield
        return
    url = f"http://127.0.0.1:{subject.ports.metrics}/tap"
    deadline = time.monotonic() + 30
    while not answers(subject.ports.metrics):  # it is the last thing that a router opens
        subject.check(deadline)
        time.sleep(0.1)
    reader = spawn(["curl", "--silent", "--no-buffer", url], cores().helpers, stdout=subprocess.DEVNULL)
    try:
        time.sleep(1)
        yield
        if reader.poll() is not None:
            sys.exit(f"nobody could read {url}")
    finally:
        reader.kill()
        reader.wait()


def answers(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


def cost(work: str, condition: str, rate: float, pace: Pace, folder: Path) -> tuple[float, float]:
    """CPU microseconds per datagram, and datagrams that were lost on the way."""
    table = folder / f"{work}-{condition}.yaml"
    table.write_text(TABLE.format(base=TABLES / WORKS[work], record=CONDITIONS[condition]), encoding="utf-8")
    trial = Trial(Router(f"{work}-{condition}", table), pace, folder)
    topics = ALL_TOPICS if work == "topics" else ()
    with trial.started() as subject, subscribed(topics) as listening, tapped(subject, condition == "tap"):
        warm_up(subject, pace)
        result = run(subject, Traffic(rate, pace.seconds), pace, listening)
    return result.cpu_us, result.lost + result.ros_lost


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recording", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rate", type=float, default=5000, help="datagrams per second (default: %(default)g)")
    parser.add_argument("--seconds", type=float, default=6, help="of one measurement (default: %(default)g)")
    parser.add_argument("--repeat", type=int, default=5, help="fresh processes of each (default: %(default)s)")
    args = parser.parse_args()
    build()
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.sched_setaffinity(0, {cores().helpers})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    pace = Pace(seconds=args.seconds)
    found: dict[tuple[str, str], list[float]] = {(work, condition): [] for work in WORKS for condition in CONDITIONS}
    lost = 0.0
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder
        for turn in range(args.repeat):
            for (work, condition), values in found.items():
                print(f"round {turn + 1} of {args.repeat}: {work}, {condition}", file=sys.stderr)
                cpu_us, missing = cost(work, condition, args.rate, pace, Path(folder))
                values.append(cpu_us)
                lost += missing
    print(f"CPU microseconds per datagram, {args.rate:g} per second; {lost:g} lost")
    for (work, condition), values in found.items():
        value, without = statistics.median(values), statistics.median(found[work, "none"])
        print(f"{work:10}{condition:12}{value:8.2f}{value / without:8.3f}")


if __name__ == "__main__":
    main()

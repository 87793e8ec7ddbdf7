"""Measures the existing gateway's stand-in and the router under loads of many ROS topics, and prints both.

    python -m benchmarks.gateway
    python -m benchmarks.gateway --only mixed --seconds 20 --json gateway.json

Publishing is a process of its own, on the core of the helpers; the process under test has the other.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.gateway.measuring import Metrics, measure
from benchmarks.gateway.topics import Topic, many
from benchmarks.versus.building import PROGRAMS, build
from benchmarks.versus.contenders import TABLES, Contender, Native, Router
from benchmarks.versus.processes import cores
from benchmarks.versus.report import number
from benchmarks.versus.results import commit, machine


@dataclass(frozen=True)
class Load:
    title: str
    topics: list[Topic]
    table: str


LOADS = {
    "reliable": Load("200 topics at 50 Hz, all reliable", many(200, 50, ["reliable"]), "gateway.yaml"),
    "mixed": Load(
        "200 topics at 50 Hz: a fifth best-effort, a fifth transient-local",
        many(200, 50, ["reliable", "reliable", "reliable", "best_effort", "transient_local"]),
        "gateway.yaml",
    ),
}
LABELS = {
    "cpu_percent": "CPU, % of a core",
    "cpu_us_per_packet": "CPU per packet, us",
    "memory_mb": "memory, MB",
    "topics": "topics",
    "served": "topics of which data came",
    "at_rate": "topics that came twice a second",
    "packets_per_s": "data packets/s",
    "kB_per_s": "kB/s",
    "repeated": "packets without a new value, of 1",
    "arrival_ms_p50": "age of the value on arrival, median, ms",
    "arrival_ms_p95": "  95th percentile",
    "arrival_ms_max": "  longest",
    "age_ms_p50": "its age by the packet's stamp, median, ms",
    "age_ms_p95": "  95th percentile",
    "age_ms_max": "  longest",
    "transit_ms_p50": "from stamp to arrival, median, ms",
    "transit_ms_p95": "  95th percentile",
    "transit_ms_max": "  longest",
    "noise": "others on the core, of 1",
    "load_late_ms": "latest publication was late by, ms",
}


def contenders(load: Load) -> list[Contender]:
    """The stand-in once as it is, and once without its log, which has a line for each packet."""
    names = ",".join(topic.name for topic in load.topics)
    return [
        Native("peer", "gateway_peer", ("--topics", names)),
        Native("quiet peer", "gateway_peer", ("--topics", names, "--log-level", "warn")),
        Router("router", TABLES / load.table),
    ]


def medians(rounds: Sequence[Metrics]) -> Metrics:
    return {metric: statistics.median(one.get(metric, 0.0) for one in rounds) for metric in rounds[0]}


def table(load: Load, found: Mapping[str, Metrics]) -> str:
    names = [*found]
    lines = [load.title, f"{'':42}" + "".join(f"{name:>12}" for name in names) + f"{'ratio':>9}"]
    for metric, label in LABELS.items():
        values = [found[name].get(metric) for name in names]
        shown = "".join(f"{'-' if value is None else number(value):>12}" for value in values)
        first, last = values[0], values[-1]
        ratio = f"{last / first:9.2f}" if first and last is not None and len(names) > 1 else ""
        lines.append(f"{label:42}{shown}{ratio}")
    return "\n".join(lines) + "\n"


def build_all() -> None:
    """Ends this program where the stand-in cannot be built."""
    build()
    if not (PROGRAMS / "gateway_peer").exists():
        (PROGRAMS / "made").unlink()  # what was missing may have been installed since
        build()
    if not (PROGRAMS / "gateway_peer").exists():
        sys.exit("there is nothing to compare with; above is what gateway_peer needs")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gateway", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--only", choices=LOADS, action="append", help="this load; can be given again (default: all)")
    add("--subject", choices=["peer", "quiet peer", "router"], action="append", help="this one (default: all)")
    add("--repeat", type=int, default=3, help="fresh processes of each contender (default: %(default)s)")
    add("--seconds", type=float, default=15, help="length of one measurement (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write the figures of all rounds there")
    return parser.parse_args()


def measured(load: Load, args: argparse.Namespace, folder: Path) -> dict[str, list[Metrics]]:
    """The contenders in turns, each time as a fresh process."""
    chosen = [one for one in contenders(load) if not args.subject or one.name in args.subject]
    rounds: dict[str, list[Metrics]] = {one.name: [] for one in chosen}
    for turn in range(args.repeat):
        for one in chosen:
            print(f"{load.title}: round {turn + 1} of {args.repeat}, {one.name}", file=sys.stderr)
            rounds[one.name].append(measure(one, load.topics, args.seconds, folder))
    return rounds


def main() -> None:
    args = arguments()
    build_all()
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # where the stand-in looks for packages
    os.sched_setaffinity(0, {cores().helpers})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    results: dict[str, Any] = {"machine": machine(), "commit": commit(), "loads": {}}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder
        for name in args.only or LOADS:
            rounds = measured(LOADS[name], args, Path(folder))
            print(table(LOADS[name], {one: medians(found) for one, found in rounds.items()}), flush=True)
            results["loads"][name] = {"title": LOADS[name].title, "seconds": args.seconds, "rounds": rounds}
            if args.json:
                args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

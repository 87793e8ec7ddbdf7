"""Measures scenarios, prints each, and merges them into the file of results."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.versus import report, results, sized, unrecorded
from benchmarks.versus.building import build
from benchmarks.versus.contenders import REALTIME
from benchmarks.versus.figures import judge
from benchmarks.versus.processes import cores
from benchmarks.versus.scenarios import SCENARIOS, Scenario
from benchmarks.versus.trial import QUICK, Metrics, Pace, Trial


def measured(scenario: Scenario, pace: Pace, repeat: int, folder: Path) -> dict[str, Any]:
    """The contenders in turns, A B A B, each time as a fresh process."""
    rounds: dict[str, list[Metrics]] = {contender.name: [] for contender in scenario.contenders}
    for turn in range(repeat):
        for contender in scenario.contenders:
            print(f"{scenario.name}: round {turn + 1} of {repeat}, {contender.name}", file=sys.stderr)
            rounds[contender.name].append(scenario.measure(Trial(contender, pace, folder)))
    return results.entry(scenario.title, rounds, judge(scenario.aims, rounds), pace.seconds)


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    known = {scenario.name: scenario for scenario in SCENARIOS}

    def scenarios(text: str) -> list[Scenario]:
        try:
            return [known[name] for name in text.split(",")]
        except KeyError as error:
            raise argparse.ArgumentTypeError(f"no scenario {error}; there are {', '.join(known)}") from None

    parser = argparse.ArgumentParser(prog="python -m benchmarks.versus", description=__doc__)
    add = parser.add_argument
    add("--only", type=scenarios, default=list(SCENARIOS), metavar="NAME[,NAME]", help="these scenarios")
    add("--repeat", type=int, default=5, help="fresh processes of each contender (default: %(default)s)")
    add("--seconds", type=float, default=Pace.seconds, help="length of one run (default: %(default)s)")
    add("--quick", action="store_true", help="everything once and too short, to see that it works")
    add("--output", type=Path, help=f"file of results (default: {results.DEFAULT.name}; with --quick none)")
    return parser.parse_args(words)


def _require_realtime() -> None:
    """Ends this program if it may not start others at a real-time priority."""
    if subprocess.run([*REALTIME, "true"], stderr=subprocess.DEVNULL, check=False).returncode:
        sys.exit("these scenarios start programs at a real-time priority: run as root, or others with --only")


def main() -> None:
    args = arguments()
    pace = QUICK if args.quick else replace(Pace(), seconds=args.seconds)
    output = args.output or (None if args.quick else results.DEFAULT)
    known = results.load(output) if output else results.empty()
    if any(contender.realtime for scenario in args.only for contender in scenario.contenders):
        _require_realtime()
    build()
    for size in sized.SIZES:
        sized.write(size, size.folder)
    unrecorded.write()
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.sched_setaffinity(0, {cores().helpers})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = os.environ["STATE_DIRECTORY"] = folder
        for scenario in args.only:
            entry = measured(scenario, pace, 1 if args.quick else args.repeat, Path(folder))
            print(report.text(scenario.name, entry), flush=True)
            results.merge(known, scenario.name, entry)
            if output:
                results.store(output, known)


if __name__ == "__main__":
    main()

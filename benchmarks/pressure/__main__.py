"""How late a router forwards and brakes while something presses on it, and what a datagram costs it then.

    python -m benchmarks.pressure --seconds 5 --repeat 3        # as `make bench` does; writes the file of results
    python -m benchmarks.pressure --only http,images --rate 20000 --repeat 3 --output pressure.json
    python -m benchmarks.pressure --command "env -C DIR PYTHONPATH=DIR .venv/bin/python -m router run TABLE"
    python -m benchmarks.pressure --only busy --vs "OUT/cpp_peer --listen LISTEN --to FIRST --to SECOND"

Each round is a fresh process on a core of its own, with the table of a rover on the loopback interface: four payload
cases go from one board to one destination and one topic each, while commands come by UDP and from ROS, in bursts with
silences between in which their deadmen have to brake. Latency is from just before a datagram is sent to the kernel's
time stamp on arrival. Brake times are from the last command that was sent to the first brake that the board got, less
the deadman's timeout. Without --command, this router is measured twice, without and with the right to a real-time
priority, and the figures are merged into the file of results. Subjects take turns. Where a pressure did not press, or
the receiver lost something, the figures are INVALID. Takes Linux, two cores, a C compiler and rclpy; root for real-time
priorities and for `second-router`.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.pressure import figures
from benchmarks.pressure.figures import Round
from benchmarks.pressure.pressures import PRESSURES, Pressure
from benchmarks.pressure.trial import Command, Settings, Trial, build
from benchmarks.versus import results
from benchmarks.versus.figures import judge
from benchmarks.versus.processes import cores

OURS = f"{shlex.quote(sys.executable)} -m router run TABLE"
REALTIME = "router_realtime"

Rounds = dict[str, dict[str, list[Round]]]
"""Subject -> pressure -> its rounds."""


def measured(subjects: Sequence[Command], pressures: Sequence[Pressure], repeat: int, settings: Settings) -> Rounds:
    found: Rounds = {subject.name: {} for subject in subjects}
    number = 0
    for turn in range(repeat):
        for pressure in pressures:
            number += 1
            for subject in subjects:
                if pressure.for_routers and not subject.is_router:
                    continue
                print(f"round {turn + 1} of {repeat}, {pressure.name}, {subject.name}", file=sys.stderr, flush=True)
                result = Trial(subject, pressure, settings, number).run()
                found[subject.name].setdefault(pressure.name, []).append(result)
                print(f"  {json.dumps(result._asdict())}", file=sys.stderr, flush=True)
    return found


def rows(found: Rounds) -> dict[str, dict[str, figures.Row]]:
    first, other = next(iter(found)), found.get("other", {})
    return {
        subject: {
            pressure: figures.row(
                pressure, one, rounds.get(figures.ALONE, []), other.get(pressure, []) if subject == first else []
            )
            for pressure, one in rounds.items()
        }
        for subject, rounds in found.items()
    }


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    known = {pressure.name: pressure for pressure in PRESSURES}

    def chosen(text: str) -> list[Pressure]:
        """`alone` is always among them: the others are compared to it."""
        if unknown := set(text.split(",")) - known.keys():
            raise argparse.ArgumentTypeError(f"no pressure {', '.join(unknown)}; there are {', '.join(known)}")
        return [pressure for pressure in PRESSURES if pressure.name in (figures.ALONE, *text.split(","))]

    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pressure", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--command", help="starts another router; TABLE is the path of its table. Writes no results")
    add(
        "--vs",
        help="starts one to compare with, or a program that takes LISTEN and FIRST, as addresses, instead of TABLE. "
        "Writes no results",
    )
    add("--only", type=chosen, default=list(PRESSURES), metavar="NAME[,NAME]", help=f"of {', '.join(known)}")
    add("--rate", type=float, default=1000, help="datagrams per second (default: %(default)g)")
    add("--seconds", type=float, default=10, help="length of one run (default: %(default)g)")
    add("--repeat", type=int, default=5, help="fresh processes for each pressure (default: %(default)s)")
    add("--seed", type=int, default=1, help="of traffic and commands (default: %(default)s)")
    add("--output", type=Path, help="file that gets everything as JSON")
    return parser.parse_args(words)


def report(args: argparse.Namespace, found: Rounds) -> dict[str, Any]:
    settings = {name: getattr(args, name) for name in ("command", "vs", "rate", "seconds", "repeat", "seed")}
    summary = {
        subject: {pressure: {**one._asdict(), "verdict": figures.verdict(one)} for pressure, one in each.items()}
        for subject, each in rows(found).items()
    }
    rounds = {
        subject: {pressure: [one._asdict() for one in each] for pressure, each in pressures.items()}
        for subject, pressures in found.items()
    }
    return {"machine": results.machine(), "settings": settings, "summary": summary, "rounds": rounds}


def subjects(args: argparse.Namespace, folder: Path) -> list[Command]:
    """Named as in the file of results, if they go there."""
    if is_for_results(args):
        return [
            Command("router", folder, command=OURS),
            Command(REALTIME, folder, command=OURS, realtime=True),
        ]
    commands = {"router": args.command or OURS} | ({"other": args.vs} if args.vs else {})
    return [Command(name, folder, command=command, realtime=True) for name, command in commands.items()]


def is_for_results(args: argparse.Namespace) -> bool:
    return not args.command and not args.vs


def store(args: argparse.Namespace, found: Rounds) -> None:
    """Merges each pressure into the file of results, as a scenario."""
    known = results.load(results.DEFAULT)
    for pressure in args.only:
        rounds = {
            subject: [{**one.metrics, "invalid": len(one.invalid)} for one in each[pressure.name]]
            for subject, each in found.items()
        }
        title = f"Forwarding and brakes at {args.rate:,.0f} per second, beside {pressure.title}"
        judged = judge(figures.aims(pressure.name, [*rounds]), rounds)
        results.merge(known, f"pressure_{pressure.name}", results.entry(title, rounds, judged, args.seconds))
    results.store(results.DEFAULT, known)


def main() -> None:
    args = arguments()
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.sched_setaffinity(0, {cores().helpers})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["ROS_LOG_DIR"] = name
        build(folder)
        settings = Settings(args.rate, args.seconds, args.seed, folder, folder)
        found = measured(subjects(args, folder), args.only, args.repeat, settings)
    for subject, each in rows(found).items():
        print(figures.text(subject, each), end="\n\n")
    if is_for_results(args):
        store(args, found)
    if args.output:
        args.output.write_text(json.dumps(report(args, found), indent=1))


if __name__ == "__main__":
    main()

"""Measures a fleet: rovers and operators behind one Zenoh hub with TLS and access control, all on this computer.

    python -m benchmarks.fleet
    python -m benchmarks.fleet --rovers 2 --operators 1 --seconds 3 --json fleet.json

Each rover is a `router run` with a ROS domain of its own, a simulated board that sends to it, and one that obeys. It all
runs in a network namespace. Exit code 1 where sums do not come out, or a deadman did not do what it should.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmarks.fleet.actors import Told
from benchmarks.fleet.figures import Figures, braked, carried, dropped, first_after, imbalances, spread
from benchmarks.fleet.site import PATIENCE, Fleet, cpu_ns, memory
from benchmarks.versus.results import commit, machine

DOWN = 2.0
"""Seconds for which the hub is away, and an operator is gone."""

DRAIN = 1.0
"""Seconds in which everything that was sent arrives."""

INSIDE = "FLEET_NAMESPACE"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=(__doc__ or "").partition("\n")[0])
    add = parser.add_argument
    add("--rovers", type=int, default=20, help="at most 100 (default: %(default)s)")
    add("--operators", type=int, default=5, help="each drives an equal share (default: %(default)s)")
    add("--board-rate", type=float, default=20.0, metavar="HZ", help="messages of each board (default: %(default)s)")
    add("--command-rate", type=float, default=10.0, metavar="HZ", help="commands to each rover (default: %(default)s)")
    add("--seconds", type=float, default=20.0, help="of each measurement (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write the figures there")
    return parser.parse_args()


def main() -> int:
    args = arguments()
    if INSIDE not in os.environ:
        enter_namespace()
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    results: Figures = {"machine": machine(), "commit": commit(), "arguments": {**vars(args), "json": None}}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        rates = (args.board_rate, args.command_rate)
        fleet = Fleet(Path(folder), args.rovers, args.operators, rates, opened)
        everybody = [*fleet.drivers]
        fleet.start(everybody[:1])
        results["one"] = measured(fleet, everybody[:1], args.seconds)
        fleet.start(everybody[1:])
        results["all"] = measured(fleet, everybody, args.seconds)
        results["hub"] = without_hub(fleet, everybody)
        results["operator"] = without_operator(fleet, everybody)
    results["wrong"] = [*results["one"].pop("wrong"), *results["all"].pop("wrong"), *wrong(results, args.rovers)]
    print(report(results))
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 1 if results["wrong"] else 0


def enter_namespace() -> None:
    """Run this program again in a network namespace of its own."""
    user = ["--map-root-user"] if os.geteuid() else []
    os.environ[INSIDE] = "1"
    os.execvp("unshare", ["unshare", "--net", *user, sys.executable, "-m", "benchmarks.fleet", *sys.argv[1:]])  # noqa: S606, S607


# -- phases --------------------------------------------------------------------------------------------------------


def flow(fleet: Fleet, rovers: Sequence[int]) -> None:
    """Boards and operators of these rovers send, of no other ones."""
    fleet.boards.tell("send", rovers)
    for number, operator in fleet.operators.items():
        operator.tell("send", [rover for rover in rovers if fleet.drivers[rover] == number])


def take(fleet: Fleet) -> tuple[Told, Told]:
    """What boards and operators recorded since they were asked last."""
    told = [operator.take() for operator in fleet.operators.values()]
    operators = Told(*([record for one in told for record in one[kind]] for kind in range(3)))
    return fleet.boards.take(), operators


def await_flow(fleet: Fleet, rovers: Sequence[int], since: int = 0) -> tuple[Told, Told]:
    """Wait until every rover was heard and driven after `since`. Return all that was recorded meanwhile."""
    deadline = time.monotonic() + PATIENCE
    boards, operators = take(fleet)
    while any(first_after(told.received, since).keys() < set(rovers) for told in (boards, operators)):
        if time.monotonic() > deadline:
            raise SystemExit(f"not all of {len(rovers)} rovers were heard and driven")
        time.sleep(0.2)
        for told, more in zip((boards, operators), take(fleet), strict=True):
            for kind, records in zip(told, more, strict=True):
                kind.extend(records)
    return boards, operators


def measured(fleet: Fleet, rovers: Sequence[int], seconds: float) -> Figures:
    flow(fleet, rovers)
    await_flow(fleet, rovers)
    flow(fleet, [])
    time.sleep(DRAIN)
    take(fleet)
    before = {rover: fleet.scrape(rover) for rover in rovers}
    pids = {"hub": fleet.hub.pid, **{str(rover): fleet.routers[rover].pid for rover in rovers}}
    flow(fleet, rovers)
    cpu, began = {name: cpu_ns(pid) for name, pid in pids.items()}, time.monotonic()
    time.sleep(seconds)
    used, elapsed = {name: cpu_ns(pid) - cpu[name] for name, pid in pids.items()}, time.monotonic() - began
    flow(fleet, [])
    time.sleep(DRAIN)
    boards, operators = take(fleet)
    counted = {rover: fleet.scrape(rover) - before[rover] for rover in rovers}
    up = carried(boards.sent, operators.received, elapsed)
    down = carried(operators.sent, boards.received, elapsed)
    routers = [used[str(rover)] / elapsed / 1e7 for rover in rovers]
    sizes = [memory(pids[str(rover)]) for rover in rovers]
    return {
        "rovers": len(rovers),
        "seconds": round(elapsed, 1),
        "rover_to_operator": up,
        "operator_to_rover": down,
        "dropped": dict(sum((Counter(dropped(one)) for one in counted.values()), Counter())),
        "hub_cpu_percent": round(used["hub"] / elapsed / 1e7, 2),
        "hub_cpu_us_per_message": round(used["hub"] / 1e3 / max(1, up["received"] + down["received"]), 1),
        "hub_memory_mb": memory(pids["hub"]),
        "router_cpu_percent": round(statistics.median(routers), 2),
        "router_memory_mb": {kind: round(statistics.median(size[kind] for size in sizes), 1) for kind in sizes[0]},
        "wrong": books(rovers, counted, boards, operators),
    }


def books(rovers: Sequence[int], counted: dict[int, Counter[str]], boards: Told, operators: Told) -> list[str]:
    """Sums that do not come out."""
    ends = [Counter(record[0] for record in records) for records in (*boards[:2], *operators[:2])]
    found = []
    for rover in rovers:
        sent, obeyed, ordered, heard = (end[rover] for end in ends)
        found += [f"rover {rover}: {what}" for what in imbalances(counted[rover], (sent, heard), (ordered, obeyed))]
    return found


def without_hub(fleet: Fleet, rovers: Sequence[int]) -> Figures:
    """The hub is killed, and comes back after a while."""
    flow(fleet, rovers)
    await_flow(fleet, rovers)
    time.sleep(DRAIN)
    fleet.hub.kill()
    fleet.hub.wait()
    killed = time.monotonic_ns()
    time.sleep(DOWN)
    fleet.start_hub()
    back = time.monotonic_ns()
    boards, operators = await_flow(fleet, rovers, back)
    brakes = braked(boards, rovers, killed)
    return {
        "rovers": len(rovers),
        "braked": len(brakes),
        "brake_after_ms": spread([*brakes.values()]),
        "driven_again_after_ms": spread([*first_after(boards.received, back).values()]),
        "heard_again_after_ms": spread([*first_after(operators.received, back).values()]),
    }


def without_operator(fleet: Fleet, rovers: Sequence[int]) -> Figures:
    """The first operator's process is killed."""
    time.sleep(2 * DRAIN)
    take(fleet)
    number = fleet.drivers[rovers[0]]
    fleet.operators.pop(number).kill()
    killed = time.monotonic_ns()
    time.sleep(DOWN)
    boards, _ = take(fleet)
    flow(fleet, [])
    his = [rover for rover in rovers if fleet.drivers[rover] == number]
    others = [rover for rover in rovers if fleet.drivers[rover] != number]
    brakes = braked(boards, his, killed)
    gaps = [gap for rover in others for gap in waits(boards, rover)]
    return {
        "his_rovers": len(his),
        "braked": len(brakes),
        "brake_after_ms": spread([*brakes.values()]),
        "other_rovers": len(others),
        "others_braked": len(braked(boards, others, killed)),
        "others_gap_ms": spread(gaps),
    }


def waits(boards: Told, rover: int) -> list[float]:
    """Milliseconds between commands to one rover."""
    times = [at for one, _, at in boards.received if one == rover]
    return [(later - earlier) / 1e6 for earlier, later in zip(times, times[1:])]


# -- the report ----------------------------------------------------------------------------------------------------


def wrong(results: Figures, rovers: int) -> list[str]:
    """Deadmen that did not trip, or tripped though commands came."""
    hub, operator = results["hub"], results["operator"]
    found = []
    if hub["braked"] != rovers:
        found.append(f"without the hub, {hub['braked']} of {rovers} rovers were braked")
    if operator["braked"] != operator["his_rovers"]:
        found.append(f"without their operator, {operator['braked']} of {operator['his_rovers']} rovers were braked")
    if operator["others_braked"]:
        found.append(f"{operator['others_braked']} rovers of other operators were braked")
    return found


def report(results: Figures) -> str:
    one, whole, hub, operator = (results[name] for name in ("one", "all", "hub", "operator"))
    lines = [f"{'':34}{one['rovers']:>10} rover{whole['rovers']:>9} rovers"]

    def row(label: str, *path: str) -> None:
        values = []
        for found in (one, whole):
            for step in path:
                found = found[step]
            values.append(found)
        lines.append(f"{label:34}{values[0]!s:>16}{values[1]!s:>16}")

    for way, label in (("rover_to_operator", "rover -> operator"), ("operator_to_rover", "operator -> rover")):
        row(f"{label}, messages/s", way, "per_second")
        row("  sent", way, "sent")
        row("  lost", way, "lost")
        for part in ("p50", "p99", "max"):
            row(f"  latency {part}, ms", way, "latency_ms", part)
    row("hub: CPU, % of a core", "hub_cpu_percent")
    row("  CPU per message, us", "hub_cpu_us_per_message")
    row("router: CPU, % of a core", "router_cpu_percent")
    row("  memory, MB", "router_memory_mb", "rss")
    row("  of it its own", "router_memory_mb", "private")
    ratio = whole["hub_cpu_us_per_message"] / one["hub_cpu_us_per_message"]
    lines += [
        f"CPU per message of the hub, {whole['rovers']} rovers over 1: {ratio:.2f}",
        f"dropped by routers: {whole['dropped'] or 'nothing'}",
        f"hub killed: {hub['braked']} of {hub['rovers']} rovers braked, after {hub['brake_after_ms']} ms",
        f"  hub back: driven again after {hub['driven_again_after_ms']} ms, heard again {hub['heard_again_after_ms']} ms",
        f"operator killed: {operator['braked']} of his {operator['his_rovers']} rovers braked, after "
        f"{operator['brake_after_ms']} ms",
        f"  of {operator['other_rovers']} others braked: {operator['others_braked']}; between their commands "
        f"{operator['others_gap_ms']} ms",
        *results["wrong"],
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())

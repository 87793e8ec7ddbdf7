"""Measures a fleet: rovers and operators behind one Zenoh hub with TLS and access control, all on this computer.

    python -m benchmarks.fleet
    python -m benchmarks.fleet --rovers 2 --operators 1 --seconds 3 --json fleet.json

Each rover is a `router run` with a ROS domain of its own, a simulated board that sends to it, and one that obeys.
Everything runs in a network namespace. Exit code 1 where sums do not come out, or a deadman did not do what it should.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

from benchmarks.fleet.actors import Told
from benchmarks.fleet.figures import Figures, carried, counted, dropped, first_after, imbalances, spread
from benchmarks.fleet.report import report, wrong
from benchmarks.fleet.site import PATIENCE, Fleet, cpu_ns, entries, memory
from benchmarks.versus.results import commit, machine
from demo.places import alone
from router.observe.snapshot import Snapshot

DOWN = 2.0
"""Seconds for which the hub is away, and an operator is gone."""

CUT = 22.0
"""Seconds for which half of the rovers are cut off from the hub: it notices after 10 s, and Linux 10 s later."""

DRAIN = 1.0
"""Seconds without an arrival after which nothing is on its way."""

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
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started is ended too
    results: Figures = {"machine": machine(), "commit": commit(), "arguments": {**vars(args), "json": None}}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        rates = (args.board_rate, args.command_rate)
        fleet = Fleet(Path(folder), args.rovers, args.operators, rates, opened)
        everybody = [*fleet.drivers]
        first, others = everybody[:1], everybody[1:]
        fleet.start(first)
        results["one"] = measured(fleet, first, args.seconds)
        fleet.start(others)
        results["all"] = measured(fleet, everybody, args.seconds)
        results["hub"] = without_hub(fleet, everybody)
        results["links"] = without_links(fleet, everybody)
        results["operator"] = without_operator(fleet, everybody)
    results["wrong"] = [*results["one"].pop("wrong"), *results["all"].pop("wrong"), *wrong(results, args.rovers)]
    print(report(results))
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 1 if results["wrong"] else 0


def enter_namespace() -> None:
    """Run this program again in a network namespace of its own."""
    if (wrapper := alone()) is None or shutil.which("nft") is None:
        raise SystemExit("a fleet needs `unshare`, `ip`, `nft` and the right to make a network namespace")
    os.environ[INSIDE] = "1"
    os.execvp(wrapper[0], [*wrapper, sys.executable, "-m", "benchmarks.fleet", *sys.argv[1:]])  # noqa: S606


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
        add(boards, operators, *take(fleet))
    return boards, operators


def drained(fleet: Fleet) -> tuple[Told, Told]:
    """Stop all sending, and wait until nothing arrives any more. Return all that was recorded."""
    flow(fleet, [])
    boards, operators = take(fleet)
    is_quiet = False
    while not is_quiet:
        time.sleep(DRAIN)
        more = take(fleet)
        is_quiet = not any(told.received for told in more)
        add(boards, operators, *more)
    return boards, operators


def add(boards: Told, operators: Told, more_boards: Told, more_operators: Told) -> None:
    for told, more in ((boards, more_boards), (operators, more_operators)):
        for kind, records in zip(told, more, strict=True):
            kind.extend(records)


def measured(fleet: Fleet, rovers: Sequence[int], seconds: float) -> Figures:
    flow(fleet, rovers)
    await_flow(fleet, rovers)
    drained(fleet)
    before = {rover: fleet.scrape(rover) for rover in rovers}
    pids = {"hub": fleet.hub.pid, **{str(rover): fleet.routers[rover].pid for rover in rovers}}
    flow(fleet, rovers)
    cpu, began = {name: cpu_ns(pid) for name, pid in pids.items()}, time.monotonic()
    time.sleep(seconds)
    used, elapsed = {name: cpu_ns(pid) - cpu[name] for name, pid in pids.items()}, time.monotonic() - began
    boards, operators = drained(fleet)
    counts = {rover: counted(before[rover], fleet.scrape(rover)) for rover in rovers}
    up = carried(boards.sent, operators.received, elapsed)
    down = carried(operators.sent, boards.received, elapsed)
    routers = [used[str(rover)] / elapsed / 1e7 for rover in rovers]
    sizes = [memory(pids[str(rover)]) for rover in rovers]
    return {
        "rovers": len(rovers),
        "seconds": round(elapsed, 1),
        "rover_to_operator": up,
        "operator_to_rover": down,
        "dropped": dict(sum(map(dropped, counts.values()), Counter())),
        "hub_cpu_percent": round(used["hub"] / elapsed / 1e7, 2),
        "hub_cpu_us_per_message": round(used["hub"] / 1e3 / max(1, up["received"] + down["received"]), 1),
        "hub_memory_mb": memory(pids["hub"]),
        "router_cpu_percent": round(statistics.median(routers), 2),
        "router_memory_mb": {kind: round(statistics.median(size[kind] for size in sizes), 1) for kind in sizes[0]},
        "wrong": books(counts, boards, operators),
    }


def books(counts: dict[int, Snapshot], boards: Told, operators: Told) -> list[str]:
    """Sums that do not come out."""
    ends = [Counter(record[0] for record in records) for records in (*boards[:2], *operators[:2])]
    found = []
    for rover, count in counts.items():
        sent, obeyed, ordered, heard = (end[rover] for end in ends)
        found += [f"rover {rover}: {what}" for what in imbalances(count, (sent, heard), (ordered, obeyed))]
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
    brakes = first_after(boards.brakes, killed)
    return {
        "rovers": len(rovers),
        "braked": len(brakes),
        "brake_after_ms": spread([*brakes.values()]),
        "driven_again_after_ms": spread([*first_after(boards.received, back).values()]),
        "heard_again_after_ms": spread([*first_after(operators.received, back).values()]),
    }


def without_links(fleet: Fleet, rovers: Sequence[int]) -> Figures:
    """Half of the rovers are cut off from the hub for a while."""
    flow(fleet, rovers)
    await_flow(fleet, rovers)
    time.sleep(2 * DRAIN)
    take(fleet)
    lost, others = rovers[::2], rovers[1::2]
    fleet.cut(lost)
    cut = time.monotonic_ns()
    time.sleep(CUT)
    hub = {"threads": entries(fleet.hub.pid, "task"), "descriptors": entries(fleet.hub.pid, "fd")}
    boards, _ = take(fleet)
    fleet.mend()
    back = time.monotonic_ns()
    later, _ = await_flow(fleet, rovers, back)
    brakes = first_after(boards.brakes, cut)
    return {
        "lost": len(lost),
        "lost_braked": len(brakes.keys() & set(lost)),
        "brake_after_ms": spread([after for rover, after in brakes.items() if rover in lost]),
        "driven_again_after_ms": spread([*(first_after(later.received, back)[rover] for rover in lost)]),
        "others": len(others),
        "others_braked": len(brakes.keys() & set(others)),
        "others_gap_ms": spread([gap for rover in others for gap in waits(boards, rover)]),
        "hub": hub,
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
    others = [rover for rover in rovers if fleet.drivers[rover] != number]
    brakes = first_after(boards.brakes, killed)
    his = [after for rover, after in brakes.items() if fleet.drivers[rover] == number]
    gaps = [gap for rover in others for gap in waits(boards, rover)]
    return {
        "his_rovers": len(rovers) - len(others),
        "braked": len(his),
        "brake_after_ms": spread(his),
        "other_rovers": len(others),
        "others_braked": len(brakes) - len(his),
        "others_gap_ms": spread(gaps),
    }


def waits(boards: Told, rover: int) -> list[float]:
    """Milliseconds between commands to one rover."""
    times = [at for one, _, at in boards.received if one == rover]
    return [(later - earlier) / 1e6 for earlier, later in pairwise(times)]


if __name__ == "__main__":
    sys.exit(main())

"""`router tap [CASE...]`: print what a running router receives and sends by itself, one line per datagram."""

from __future__ import annotations

import argparse

from router.cli import Subparsers, add_verb
from router.cli.completion import cases, completes, endpoints
from router.cli.tool_options import (
    add_count,
    add_for,
    add_url_option,
    add_wire_options,
    load_wire,
    print_batches,
    running_url,
    say,
    until_interrupted,
)

_DESCRIPTION = """Print what a running router receives: the fields that are not at their default, those beside the
payload as 'envelope.seq=5', and the reason for each rejected datagram. Without --from and --only, also print the
commands that it sends, and what its deadmen do. The router is reached at the table's 'http.address', on this
computer. It never waits for this terminal; lines that the terminal missed are counted. To listen at a port or a ROS
topic without a router, use 'router listen'."""
_EXAMPLES = (
    "router tap imu_info gps_info -t routes/sim.yaml",
    "router tap --from arm_board --for 10s",
    "router tap --only rejected",
    "router tap imu_info --where 'accel_z < 0 or not is_calibrated'",
    "router tap --count 100 --json > hundred.jsonl",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "tap", _DESCRIPTION, *_EXAMPLES)
    completes(
        parser.add_argument("cases", nargs="*", metavar="CASE", help="only these payload cases (default: everything)"),
        cases,
    )
    about = "only from this endpoint or IP address; may be repeated"
    completes(
        parser.add_argument("--from", dest="sources", action="append", default=[], metavar="ENDPOINT", help=about),
        endpoints,
    )
    about = "only datagrams that a route took, or only those that none took"
    parser.add_argument("--only", choices=("accepted", "rejected"), help=about)
    about = "only payloads for which this expression is true: 'satellites < 4', 'envelope.seq > 9'"
    parser.add_argument("--where", metavar="EXPR", help=about)
    add_count(parser)
    add_for(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--hex", action="store_true", help="also print the bytes")
    add_url_option(parser)
    add_wire_options(parser)


def run(args: argparse.Namespace) -> int:
    from router.threads import background_threads
    from router.tools.running_router import tap
    from router.tools.tap import Condition, Filter, RunningTap

    url = running_url(args)
    wire, _ = load_wire(args)
    cases = [wire.case(name) for name in args.cases]
    cases = cases or list(wire.envelopes.cases.values())
    condition = Condition(args.where, wire.envelopes, cases) if args.where else None
    taken = RunningTap(wire, Filter(args.cases, condition))
    wanted = args.cases or (sorted(condition.cases) if condition else [])
    # The router has priority over observers on its computer.
    with background_threads(), tap(url, wanted, args.sources, args.only) as batches:
        say(f"tapping the router at {url}; press Ctrl-C to stop")
        try:
            with until_interrupted():
                print_batches(taken.take(batches), args)
        finally:
            if taken.missed:
                say(f"{taken.missed} lines are not shown, as this terminal was too slow; the router routed them")
            if condition is not None and condition.failure:
                say(f"payloads for which --where has no value are not shown: {condition.failure}")
    return 0

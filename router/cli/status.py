"""`router status`: whether the router is running and healthy, as one line and an exit code, for scripts."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from router.cli import BAD_TABLE, BAD_USAGE, NETWORK_FAULT, OK, Subparsers, add_verb
from router.cli.findings import wrapped
from router.cli.tool_options import add_router_options, running_url
from router.errors import TransportError, plural

if TYPE_CHECKING:
    from router.observe.services import ServiceReading
    from router.observe.states import StateReading

DEGRADED = 3

_DESCRIPTION = f"""Print in one line whether the router of a table is running, and what is wrong with it or was in the
last few seconds, as on the status page and in /diagnostics. For remedies, run 'router doctor'.

Exit code: {OK} running and healthy, {NETWORK_FAULT} not running, {DEGRADED} running with problems, {BAD_USAGE} wrong
usage, {BAD_TABLE} a wrong table."""


_UNTIL_IT_RUNS = f"until router status || [ $? -ne {NETWORK_FAULT} ]; do sleep 1; done    # until it runs"


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router status", "router status --json", _UNTIL_IT_RUNS)
    parser = add_verb(subparsers, "status", _DESCRIPTION, *examples)
    add_router_options(parser)
    has = "a JSON object: state, url, problems, states, services, learned, received"
    parser.add_argument("--json", action="store_true", help=has)


def run(args: argparse.Namespace) -> int:
    from router.tools.running_router import down, health

    url = running_url(args)
    received = None
    states: Sequence[StateReading] = ()
    services: Sequence[ServiceReading] = ()
    learned: Mapping[str, str] = {}
    try:
        *_, received, states, services, learned, problems = answer = health(url)
        state, code = ("degraded", DEGRADED) if answer.is_degraded else ("running", OK)
    except TransportError as error:
        state, code, problems = "down", NETWORK_FAULT, (down(url, error),)
    if args.json:
        listed = [problem.json() for problem in problems]
        shown = [asdict(each) for each in states]
        called = [asdict(each) for each in services]
        known = {"state": state, "url": url, "problems": listed, "states": shown}
        print(json.dumps({**known, "services": called, "learned": learned, "received": received}))
    else:
        details = [*(problem.text for problem in problems), *(f"{each.name} is {each.value}" for each in states)]
        details += [f"service {each.name}: {each.text}" for each in services]
        details += [f"{name} is at {address}" for name, address in learned.items()]
        if received is not None:
            details.append(f"{plural(received, 'datagram')} received")
        print(wrapped(f"{state}: {'; '.join(details)}", sys.stdout))
    return code

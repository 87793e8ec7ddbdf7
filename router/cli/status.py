"""`router status`: whether the router runs and is healthy, in one line and an exit code, for scripts."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

from router.cli import BAD_TABLE, BAD_USAGE, NETWORK_FAULT, OK, Subparsers, add_verb
from router.cli.tool_options import add_router_options, running_url
from router.errors import TransportError, plural

if TYPE_CHECKING:
    from router.observe.snapshot import Snapshot

DEGRADED = 3

_DESCRIPTION = f"""Say in one line whether the router of a table runs, and what is wrong with it: a stuck receive
thread, a reload that failed, listeners without their network, boards that are silent, deadmen that send in place of
commands, publishers that are stuck.

Exit code: {OK} it runs and is healthy, {NETWORK_FAULT} none runs, {DEGRADED} it runs and something is wrong,
{BAD_USAGE} wrong usage, {BAD_TABLE} a wrong table. 'router doctor' says what to do about it."""


_UNTIL_IT_RUNS = f"until router status || [ $? -ne {NETWORK_FAULT} ]; do sleep 1; done    # until it runs"


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router status", "router status --json", _UNTIL_IT_RUNS)
    parser = add_verb(subparsers, "status", _DESCRIPTION, *examples)
    add_router_options(parser)
    parser.add_argument("--json", action="store_true", help="a JSON object: state, url, problems, received")


def run(args: argparse.Namespace) -> int:
    from router.tools.running_router import is_receiving, metrics

    url = running_url(args)
    problems: list[str] = []
    received = None
    try:
        found = metrics(url)
        received = found.total("datagrams_received")
        problems = [*([] if is_receiving(url) else ["the receive thread is stuck"]), *_problems(found)]
        state, code = ("degraded", DEGRADED) if problems else ("running", OK)
    except TransportError as error:
        state, code, problems = "down", NETWORK_FAULT, [str(error)]
    if args.json:
        print(json.dumps({"state": state, "url": url, "problems": problems, "received": received}))
    else:
        details = [*problems, *([] if received is None else [f"{plural(received, 'datagram')} received"])]
        print(f"{state}: {'; '.join(details)}")
    return code


def _problems(found: Snapshot) -> Iterator[str]:
    from router.observe.snapshot import MOST_STALLED

    if found.counts("config_last_reload_successful").get(()) == 0:
        yield "its last reload failed"
    for name in sorted(name for (name,), is_waiting in found.counts("listener_waiting").items() if is_waiting):
        yield f"listener {name} waits for its address or network interface"
    sources = {source for _, source in found.counts("messages_received")}
    limits = found.counts("endpoint_stale_after_seconds")
    for (name,), seen in found.counts("endpoint_last_seen_timestamp_seconds").items():
        if not seen or name not in sources or (name,) not in limits:
            continue  # as for alerts: who never sent is switched off
        if found.at - seen > limits[name,]:
            yield f"{name} is silent for {found.at - seen:.0f} s"
    for (route,), active in found.counts("deadman_active").items():
        if active:
            yield f"the deadman of {route} sends"
    for (topic,), seconds in found.counts("publish_stalled_seconds").items():
        if seconds > MOST_STALLED:
            yield f"publishing on {topic} is stuck in the ROS middleware, for {seconds:.0f} s"

"""`router explain`: routes and gateways as the router understands them, and the differences between two tables."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from router.cli import OK, Subparsers, add_verb
from router.cli.completion import completes, fields, routed
from router.cli.findings import wrapped
from router.cli.tool_options import add_for, add_table, good_table, table_path
from router.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from router.compiler.checked import CheckedRoute

_DESCRIPTION = """Show where a route's messages come from and where they go, what each target checks and in which
order, the whole mapping with the types on both sides, and the largest sizes. For a service, show what answers it, how
long the router waits, and its request and reply. --code adds the operations that the router executes, with their
places in the table; --given shows what each target gets from one payload. For a gateway, show what it sends and how
often, and what clients may publish; lines with ~ are the topics that its patterns match, among those in the table or,
with --live, among all topics in the ROS network. Without a name, also show which compiled programs of this table
'router run' has kept for its next start, and whether a start with the current variables uses them. --diff shows only
what two tables do differently."""
_EXAMPLES = (
    "router explain imu_info",
    "router explain imu_info --code",
    "router explain imu_info --given accel_x=1.5 state=SENSOR_OPERATING",
    "router explain dashboard --live",
    "router explain --diff routes/legacy.yaml routes/rover.yaml",
)
_LIVE = 2.0
"""Default of --for, in seconds; discovery rarely takes longer."""


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "explain", _DESCRIPTION, *_EXAMPLES)
    everything = "payload cases, states as state.NAME, services, and gateways (default: all in the table)"
    completes(parser.add_argument("names", nargs="*", metavar="NAME", help=everything), routed)
    add_table(parser)
    parser.add_argument(
        "--diff", nargs=2, type=Path, metavar=("OLD", "NEW"), help="show what table NEW does differently from OLD"
    )
    parser.add_argument("--code", action="store_true", help="also list the operations that the router executes")
    given = "show what each target gets from a payload with these fields, sent by the route's first source"
    completes(parser.add_argument("--given", nargs="*", metavar="FIELD=VALUE", help=given), fields)
    live = "also look for topics in the ROS network, and for publishers and subscribers of another type"
    parser.add_argument("--live", action="store_true", help=live)
    add_for(parser, f"how long --live looks for topics, for example 5s (default: {_LIVE:g}s)")


def run(args: argparse.Namespace) -> int:
    if args.seconds is not None and not args.live:
        raise UsageError("--for works only with --live")
    if args.diff is not None and (args.names or args.table or args.code or args.live or args.given is not None):
        raise UsageError("--diff compares two whole tables and takes no other arguments")
    if tables := [name for name in args.names if name.endswith((".yaml", ".yml"))]:
        raise UsageError(f"{tables[0]} is a table, not a route or gateway", f"write `router explain -t {tables[0]}`")
    return _diff(*args.diff) if args.diff is not None else _explain(args)


def _explain(args: argparse.Namespace) -> int:
    from router.tools.explain import (
        explained_called,
        explained_gateway,
        explained_route,
        explained_service,
        explained_state,
        ignored_gateway,
        known_topics,
        live_route,
        routes_of,
        seen_topics,
        tried_route,
    )
    from router.tools.listing import listed_route

    path = table_path(args)
    checked, program = good_table(path)
    routes: dict[str, list[CheckedRoute]] = {}
    for route in checked.routes:
        routes.setdefault(route.case.name, []).append(route)
    gateways = {gateway.settings.name: gateway for gateway in checked.gateways}
    ignored = program.table.ignored_gateways
    states = {state.label: state for state in checked.states.values()}
    services = {service.declared.name: explained_service(service) for service in checked.services}
    services |= {called.declared.name: explained_called(called, program.table) for called in checked.called}
    known = [*states, *services, *routes, *gateways, *ignored]
    for name in args.names:
        if name not in known:
            raise UsageError(f"{path} has no route, state, service or gateway '{name}'", did_you_mean(name, known))
    if args.given is not None and (len(args.names) != 1 or args.names[0] not in routes):
        raise UsageError("--given takes the fields of one payload case", "name it: router explain CASE --given x=1")
    topics, mistyped = seen_topics(program, args.seconds or _LIVE) if args.live else (known_topics(program.table), ())
    others = {name: explained_state(state, checked) for name, state in states.items()}
    others |= {name: explained_gateway(gateway, topics) for name, gateway in gateways.items()}
    others |= {name: ignored_gateway(gateway) for name, gateway in ignored.items()}
    for name in args.names or known:
        if name in services:
            _print(*services[name], "")
        of_service = routes_of(name, checked.routes) if name in services and args.names else ()
        for route in [*of_service, *routes.get(name, ())]:
            code = listed_route(route, program) if args.code else ()
            given = () if args.given is None else tried_route(route, checked, program, args.given)
            now = live_route(route.route, mistyped)
            _print(*explained_route(route, checked), *now, *code, *given, "")
        if name in others:
            _print(*others[name], "")
    if not args.names:
        _print(*_kept(path))
    return OK


def _print(*lines: str) -> None:
    for line in lines:
        print(wrapped(line, sys.stdout))


def _kept(table: Path) -> Iterator[str]:
    """Yield lines about the kept programs that were compiled from this table, or from a table that extends it."""
    from router.startup_image import store

    try:
        folder = store.folder()
        files = [*store.list_files()] if Path(folder).is_dir() else []
    except OSError as error:
        yield f"kept programs cannot be read: {error}"
        return
    real, is_any = os.path.realpath(table), False
    for path, kept, why in files:
        if kept is None:
            yield f"{path} cannot be used as a kept program: {why}"
        elif any(kind == "file" and os.path.realpath(name) == real for kind, name, *_ in kept.inputs):
            is_any = True
            command, where, python = kept.identity
            since = time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime(kept.written))
            yield f"kept for: {shlex.join(command)}"
            yield f"  in {where}, since {since}"
            if python != sys.executable:
                yield f"  made by another Python, {python}: its `router explain` says whether a start uses it"
            elif why:
                yield f"  a start does not use it: {why}"
            else:
                yield "  a start uses it"
    if not is_any:
        yield f"no program of this table is kept in {folder}: a start compiles the table first"


def _diff(old: Path, new: Path) -> int:
    from router.compiler.lookup import Definitions
    from router.tools.explain import diff

    definitions = Definitions()
    (before, _), (after, _) = (good_table(path, definitions=definitions) for path in (old, new))
    lines = list(diff(before, after))
    print(*([f"--- {old}", f"+++ {new}", *lines] if lines else [f"{new} does the same as {old}"]), sep="\n")
    return OK

"""`router explain`: a route or a gateway as the router understands it, down to the code that serves it; two tables
compared.

Prints what the compiler found out; finds out nothing itself.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from router.cli import BAD_TABLE, BAD_USAGE, DEFAULT_TABLE, OK, VERBS
from router.cli.explain_differences import print_differences
from router.cli.explain_gateway import explained_gateway, ignored_gateway, known_topics, seen_topics
from router.cli.explain_words import at_start, quality
from router.cli.findings import is_coloured, print_findings
from router.cli.tool_options import positive
from router.compiler import Checked, check_table
from router.compiler.cdr import message_size
from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.link import compile_handlers
from router.compiler.mapping import Row
from router.compiler.metrics import Counters
from router.compiler.plan import Each, Items, Plan, Record, Unset
from router.errors import did_you_mean
from router.table.model import ANY, ROS, Destination, Route, RouteTable, Topic
from router.table.quantities import duration
from router.types.sizes import framed_size

_WIDEST_CELL = 48
_DESCRIPTION = """Show where a route's messages come from and go, the whole mapping with the types on both sides,
largest sizes, and the code that the router runs. Of a gateway, show what it sends how often, and what it lets in: with
a ~ in front each topic that its patterns match, of those that the table names, or with --live of all that there are.
With --diff, say what one table does otherwise than another, and nothing else."""
_LIVE = 2.0
"""Seconds that ROS takes at most, as a rule, until a new node knows the others."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("explain", help=VERBS["explain"], description=_DESCRIPTION)
    everything = "payload cases and gateways; all of the table when none is named"
    parser.add_argument("names", nargs="*", metavar="NAME", help=everything)
    parser.add_argument("--table", type=Path, default=DEFAULT_TABLE, help="route table (default: %(default)s)")
    parser.add_argument(
        "--diff", nargs=2, type=Path, metavar=("OLD", "NEW"), help="two tables: what NEW does otherwise than OLD"
    )
    parser.add_argument("--no-code", action="store_true", help="leave the generated code out")
    live = f"look for topics in the ROS network as well, for so long (default: {_LIVE:g})"
    parser.add_argument("--live", nargs="?", type=positive, const=_LIVE, metavar="SECONDS", help=live)


def run(args: argparse.Namespace) -> int:
    if args.diff is not None:
        return print_differences(*args.diff)
    checked = check_table(args.table)
    print_findings(checked.diagnostics, sys.stderr)
    if checked.has_errors or checked.table is None:
        return BAD_TABLE
    routes: dict[str, list[CheckedRoute]] = {}
    for route in checked.routes:
        routes.setdefault(route.case.name, []).append(route)
    gateways = {gateway.settings.name: gateway for gateway in checked.gateways}
    ignored = checked.table.ignored_gateways
    known = [*routes, *gateways, *ignored]
    for name in args.names:
        if name not in known:
            hint = did_you_mean(name, known)
            print(f"router explain: {args.table} has no route or gateway '{name}'; {hint}", file=sys.stderr)
            return BAD_USAGE
    topics = known_topics(checked.table) if args.live is None else seen_topics(checked.table, args.live)
    for name in args.names or known:
        for route in routes.get(name, ()):
            _print_route(route, checked, args.no_code)
        if name in gateways:
            print(*explained_gateway(gateways[name], topics), sep="\n", end="\n\n")
        if name in ignored:
            print(*ignored_gateway(ignored[name]), sep="\n", end="\n\n")
    return OK


def _print_route(route: CheckedRoute, checked: Checked, no_code: bool) -> None:
    assert checked.table is not None  # noqa: S101 - a table without errors is one
    print(*_explained(route, checked), sep="\n")
    if not no_code and not route.route.ignore:
        for handler in compile_handlers(route, checked.table, Counters()):
            _print_code(handler.source)
    print()


def _explained(checked: CheckedRoute, everything: Checked) -> Iterator[str]:
    route, case, table, envelope = checked.route, checked.case, everything.table, everything.envelope
    assert table is not None  # noqa: S101 - a table without errors is one
    assert envelope is not None  # noqa: S101 - and has one
    yield f"{route.name}: {case.type.name}, field {case.number} of {envelope.name}  ({route.span})"
    if case.max_size is not None:
        datagram = framed_size(case.number, case.max_size)
        yield f"  largest encoding: {case.max_size} bytes, {datagram} in its envelope"
    if route.ignore is not None:
        yield f"  ignored: {route.ignore.value}"
        return
    yield f"  source: {', '.join(_source(source.value, table) for source in route.sources)}"
    yield from _settings(checked)
    for served in checked.targets:
        yield ""
        yield from _topic(served) if served.topic else _destination(served, checked.route, table, "unchanged")
    for feed in checked.feeds:
        yield ""
        yield f"  from topic {feed.topic.topic.value}: {feed.type}  ({feed.topic.span})"
        yield quality(feed.topic)
        if feed.topic.when is not None:
            yield f"    when {feed.topic.when.text}"
        for served in feed.targets:
            yield ""
            yield from _destination(served, route, table, f"from topic {feed.topic.topic.value}")


def _settings(checked: CheckedRoute) -> Iterator[str]:
    """What holds for the whole route."""
    route, deadman = checked.route, checked.deadman
    if route.ttl is not None:
        yield f"  dropped when older than {duration(route.ttl.value)}"
    if route.for_each is not None:
        yield f"  one datagram for each of {route.for_each.text}"
    if route.collect is not None:
        collect = route.collect
        yield (
            f"  frames by {collect.by.text}, of {collect.count.text} datagrams in the order of {collect.order.text}, "
            f"complete within {duration(collect.timeout.value)}"
        )
    if deadman is not None:
        yield (
            f"  deadman: {deadman.case.name} to {', '.join(deadman.to)} when no command came for "
            f"{duration(deadman.timeout)}, again every {duration(deadman.repeat)}, {at_start(deadman.at_start)}"
        )
        if deadman.hands_over_to:
            yield f"    disarmed by commands of {', '.join(deadman.hands_over_to)}"
    if route.no_deadman is not None:
        yield f"  no deadman: {route.no_deadman.value}"


def _source(name: str, table: RouteTable) -> str:
    if name in (ANY, ROS):
        return name
    endpoint = table.endpoints[name]
    port = f":{endpoint.source_port.value}" if endpoint.source_port else ""
    by = f" by listener {endpoint.listener.value}" if endpoint.listener else ""
    return f"{name} ({endpoint.address.value.host}{port}{by})"


def _destination(served: CheckedTarget, route: Route, table: RouteTable, how: str) -> Iterator[str]:
    target = served.target
    endpoint = table.endpoints[target.name]
    trimmed = ", trailing zeros trimmed" if endpoint.trim_trailing_zeros else ""
    yield f"  destination {target.name} ({endpoint.address.value}): {how}{trimmed}  ({target.span})"
    if endpoint.budget is not None:
        yield f"    {target.priority.value} within a budget of {endpoint.budget.value} bytes/s"
    if others := [other for other in target.deadmen if other != route.name]:
        yield f"    disarms the deadman of {', '.join(others)}"
    named = next(each for each in route.destinations if each.endpoint.value == target.name)
    yield from _served(served, named)


def _topic(served: CheckedTarget) -> Iterator[str]:
    target, topic = served.target, served.topic
    assert topic is not None  # noqa: S101 - the caller's choice
    yield f"  topic {target.name}: {topic.type.value}  ({target.span})"
    yield quality(topic)
    if target.plan is not None:
        size, exact = message_size(target.plan)
        yield f"    CDR: {size} bytes" if exact else f"    CDR: {size} bytes and the contents of strings and sequences"
    yield from _served(served, topic)


def _served(served: CheckedTarget, named: Destination | Topic) -> Iterator[str]:
    """What a target is served with, and when."""
    target = served.target
    if named.when is not None:
        yield f"    when {named.when.text}"
    if target.max_rate is not None:
        yield f"    at most {target.max_rate:g} Hz, keeping the {target.keep.value}"
    yield from _mapping(served.rows)
    if target.plan is not None and (unset := list(_unset(target.plan, ""))):
        yield f"    left at their defaults: {', '.join(unset)}"


def _mapping(rows: Sequence[Row]) -> Iterator[str]:
    """One line a field; an expression that is long pushes only what stands behind it."""
    cells = [(row.target, row.target_type, row.expression, f": {row.kind}", "auto" * row.automatic) for row in rows]
    widths = [min(max(map(len, column)), _WIDEST_CELL) for column in zip(*cells, strict=True)]
    for target, type_, expression, kind, automatic in (
        [text.ljust(width) for text, width in zip(cell, widths, strict=True)] for cell in cells
    ):
        yield f"    {target}  {type_}  <-  {expression}  {kind}  {automatic}".rstrip()


def _unset(plan: Plan, prefix: str) -> Iterator[str]:
    """The fields that nothing fills; a message of which nothing is filled counts as one."""
    match plan:
        case Unset():
            yield prefix
        case Record():
            for member, inner in plan.members:
                yield from _unset(inner, f"{prefix}.{member.name}" if prefix else member.name)
        case Items():
            for index, inner in enumerate(plan.items):
                yield from _unset(inner, f"{prefix}[{index}]")
        case Each():
            yield from _unset(plan.element, f"{prefix}[]")


def _print_code(source: str) -> None:
    print()
    if is_coloured(sys.stdout):
        from rich.console import Console
        from rich.syntax import Syntax

        Console().print(Syntax(source, "python", background_color="default"))
    else:
        print(source, end="")

"""`router top`: show a running router at a glance, from its metrics."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from typing import TYPE_CHECKING

from router.cli import OK, Subparsers, add_verb
from router.cli.tool_options import add_router_options, running_url, seconds
from router.errors import TransportError

if TYPE_CHECKING:
    from router.tools.top import Order, View

ORDERS = ("table", "rate", "drops", "age", "latency")
_DESCRIPTION = """Show each route of a running router: messages per second, where they went, what was dropped and why,
the time since the last one, and the latency, median (p50) and 99th percentile (p99). Problems, the values of states,
calls of services, and when each endpoint was last heard, come first. `!` marks what is wrong now; `+2` means that two
targets do not fit. Without drops there is a `-`, or `none accepted` where a deadman sends because the route accepts
no command. On a terminal the display is live; keys sort and scroll it."""


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router top", "router top -t routes/sim.yaml --sort drops", "router top --once --json")
    parser = add_verb(subparsers, "top", _DESCRIPTION, *examples)
    add_router_options(parser)
    parser.add_argument(
        "--sort", choices=ORDERS, default=ORDERS[0], help="sort by this, largest first (default: order of the table)"
    )
    about = "time between two updates, for example 500ms (default: 1s)"
    parser.add_argument("--interval", type=seconds, default=1.0, metavar="DURATION", help=about)
    parser.add_argument("--once", action="store_true", help="print once and exit (default without a terminal)")
    parser.add_argument("--json", action="store_true", help="print once, as a JSON object")


def run(args: argparse.Namespace) -> int:
    from router.tools.top import Order

    url = running_url(args)
    if args.json:
        _print_json(url, Order(args.sort), args.interval)
    elif args.once or not sys.stdout.isatty():
        _show_once(url, Order(args.sort), args.interval)
    else:
        _show(url, Order(args.sort), args.interval)
    return OK


def _print_json(url: str, order: Order, interval: float) -> None:
    """Print the fields of `View` with all rows, times in seconds; if no router answers, those of `router status`."""
    from router.tools.running_router import down
    from router.tools.top import ordered

    try:
        seen, table = _look(url, interval)
    except TransportError as error:
        print(json.dumps({"state": "down", "url": url, "problems": [down(url, error).json()]}))
        raise
    routes = [asdict(row) for row in ordered(seen.routes, order)]
    print(json.dumps({"table": table, **asdict(seen), "routes": routes}))


def _show_once(url: str, order: Order, interval: float) -> None:
    from rich.console import Console

    from router.tools.top_view import Page

    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
    seen, table = _look(url, interval)
    with console.capture() as shown:  # rich exits if a pipe is closed; `main` has an exit code for that
        console.print(Page(seen, _title(table, url), order))
    print(shown.get(), end="")


def _look(url: str, interval: float) -> tuple[View, str]:
    """Return the view, and the name of the table."""
    from router.tools.running_router import health, metrics
    from router.tools.top import view

    before = metrics(url)
    time.sleep(interval)
    after, state = metrics(url), health(url)
    return view(before, after, state.problems, state.states), state.name


def _title(table: str, url: str) -> str:
    return f"{table} at {url}"


_PLAIN_WIDTH = 160
"""Width in columns without a terminal."""


def _show(url: str, order: Order, interval: float) -> None:
    """Show the router until `q` or Ctrl-C. Retry if it does not answer: it may be starting."""
    from rich.console import Console
    from rich.live import Live

    from router.tools.running_router import health, metrics
    from router.tools.top import Order, Window, view
    from router.tools.top_view import Screen, keys

    console, orders = Console(), {choice.key: choice for choice in Order}
    window, note, first = Window(), "", 0
    window.add(metrics(url))
    state = health(url)
    with Live(console=console, screen=True, auto_refresh=False) as live, keys() as wait_for_key:
        key, due = "", 0.0
        while key != "q":
            if time.monotonic() >= due:
                due = time.monotonic() + interval
                try:
                    newest, state = metrics(url), health(url)
                except TransportError as error:
                    note = str(error)
                else:
                    if note:
                        window.clear()
                    window.add(newest)
                    note = ""
            seen = view(*window.ends, state.problems, state.states)
            shown = Screen(seen, _title(state.name, url), order, console.height, note, first)
            live.update(shown, refresh=True)
            try:
                key = wait_for_key(max(due - time.monotonic(), 0.0))
            except KeyboardInterrupt:
                return
            first = 0 if key in orders else shown.moved(key, console.width)
            order = orders.get(key, order)

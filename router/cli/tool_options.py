"""Shared by verbs: options that find the envelope or a running router, numbers in range, a progress display."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from router.assets import asset
from router.cli import DEFAULT_TABLE
from router.errors import UsageError

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from router.engine.wire import Wire
    from router.table.model import RouteTable


def add_wire_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--table", type=Path, metavar="TABLE", help=f"route table (default: {DEFAULT_TABLE}, if there)")
    group.add_argument("--protos", type=Path, metavar="DIR", help="folder of .proto files, instead of a table")


def load_wire(args: argparse.Namespace) -> tuple[Wire, RouteTable | None]:
    """Raises TableError."""
    from router.engine.wire import wire_of_protos, wire_of_table
    from router.table import read_table

    if args.protos is None and (args.table is not None or DEFAULT_TABLE.exists()):
        table = read_table(args.table or DEFAULT_TABLE)
        return wire_of_table(table), table
    return wire_of_protos(args.protos or asset("protos")), None


def add_router_options(parser: argparse.ArgumentParser) -> None:
    """Which running router: that of a table, or at a URL."""
    about = f"the table that it runs, for its http.address (default: {DEFAULT_TABLE})"
    parser.add_argument("table", nargs="?", type=Path, default=DEFAULT_TABLE, metavar="TABLE", help=about)
    add_url_option(parser)


def add_url_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--url", metavar="URL", help="where the running router answers instead: http://127.0.0.1:9108")


def running_url(args: argparse.Namespace) -> str:
    """The URL from --url or from the table, which may have errors elsewhere. Raises UsageError."""
    from router.table import load_table
    from router.tools.running_router import url_of

    if args.url:
        return str(args.url)
    table, findings = load_table(args.table or DEFAULT_TABLE)
    if table is None:
        raise UsageError(f"{findings[0]}; name the table that the router runs, or give --url")
    return url_of(table)


def say(line: str) -> None:
    """Print a line for whoever started the verb; stdout is for what it shows."""
    print(line, file=sys.stderr, flush=True)


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value <= 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not above 0 and at most 1000000")
    return value


def whole(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return value


@contextmanager
def progress(
    columns: Callable[[], Iterable[ProgressColumn]], total: int | None = None
) -> Iterator[Callable[..., None]]:
    """Show `columns` of rich on stderr if it is a terminal; the value updates them: `tell(completed=7)`."""
    if not sys.stderr.isatty():
        yield lambda **_: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(*columns(), console=Console(stderr=True), refresh_per_second=4, transient=True) as shown:
        task, told = shown.add_task("", total=total), dict[str, Any]()

        def tell(**news: Any) -> None:
            nonlocal told
            if news != told:  # called for each datagram, mostly without a change
                told = news
                shown.update(task, **news)

        yield tell

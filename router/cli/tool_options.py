"""Shared by verbs: options for table, envelope and running router; durations, rates and speeds; a progress display."""

from __future__ import annotations

import argparse
import math
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from router import inputs
from router.assets import asset
from router.cli import DEFAULT_TABLE, with_help
from router.errors import ConfigurationError, TableError, UsageError, did_you_mean_file

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from router.compiler import Checked
    from router.compiler.compiled_table import CompiledTable
    from router.compiler.lookup import Definitions
    from router.compiler.metrics import Counters
    from router.datagrams import Wire
    from router.table.model import RouteTable
    from router.tools.tap import ShownAction, TappedDatagram, TappedMessage


TABLE_VARIABLE = "ROUTER_TABLE"


def add_table(parser: argparse.ArgumentParser, *, is_subject: bool = False) -> None:
    """Add `-t TABLE`, a verb's table. If the table is the subject, it may also be a positional argument."""
    if is_subject:
        parser.add_argument("subject", nargs="?", type=Path, metavar="TABLE", help="short for -t TABLE")
    about = f"route table (default: ${TABLE_VARIABLE}, or {DEFAULT_TABLE})"
    parser.add_argument("-t", "--table", type=Path, metavar="TABLE", help=about)


def table_path(args: argparse.Namespace) -> Path:
    """Return the path of a verb's table. Raises UsageError if none is named and the default table does not exist."""
    if (named := named_table(args)) is not None:
        return named
    if not inputs.exists(DEFAULT_TABLE):
        how = f"name a table with -t TABLE or {TABLE_VARIABLE}, or write a first one: `router init DIR`"
        raise UsageError(f"there is no {DEFAULT_TABLE} here", how)
    return DEFAULT_TABLE


def named_table(args: argparse.Namespace) -> Path | None:
    """Return the table named on the command line, or else in the environment.

    Raises UsageError if two are named on the command line, ConfigurationError if that of the environment is missing.
    """
    subject: Path | None = getattr(args, "subject", None)
    option: Path | None = args.table
    if subject is not None and option is not None and inputs.real_path(subject) != inputs.real_path(option):
        raise UsageError(f"two tables are named: {subject} and, with --table, {option}", "name only one")
    if subject or option or not (of_environment := inputs.ENVIRONMENT.get(TABLE_VARIABLE)):
        return subject or option
    table = Path(of_environment)
    if not inputs.exists(table):
        what = f"there is no {of_environment}, the table that {TABLE_VARIABLE} names"
        where = "" if table.is_absolute() else f" from {Path.cwd()}"
        how = f"set it to a path that exists{where}, or name a table with -t TABLE"
        raise ConfigurationError(what, did_you_mean_file(of_environment, table) or how)
    return table


def table_if_any(args: argparse.Namespace) -> Path | None:
    """Return the table that is named, or the default table if it exists."""
    return named_table(args) or (DEFAULT_TABLE if DEFAULT_TABLE.exists() else None)


def good_table(
    path: Path,
    environ: Mapping[str, str] | None = None,
    definitions: Definitions | None = None,
    counters: Counters | None = None,
) -> tuple[Checked, CompiledTable]:
    """Check a table and print its warnings. The program counts in `counters`. Raises TableError if there are errors."""
    from router.cli.findings import print_findings
    from router.compiler import check_table

    checked = check_table(path, environ, definitions)
    program = checked.program if counters is None else checked.program_in(counters)
    if program is None:
        raise TableError(checked.diagnostics)
    print_findings(checked.diagnostics, sys.stderr)
    return checked, program


def add_tables(parser: argparse.ArgumentParser, about: str) -> None:
    """Add the options of a verb that takes several tables, or folders of tables."""
    parser.add_argument("paths", nargs="*", type=Path, metavar="PATH", help=about)
    add_table(parser)


def table_paths(args: argparse.Namespace) -> list[Path]:
    """Return the paths named to a verb with `add_tables`, or its table. Raises UsageError."""
    paths: list[Path] = args.paths
    if paths and args.table is not None and {path.resolve() for path in paths} != {args.table.resolve()}:
        raise UsageError(f"two tables are named: {paths[0]} and, with --table, {args.table}", "name only one")
    return paths or [table_path(args)]


def add_styles(parser: argparse.ArgumentParser) -> None:
    """Add the options for the format of findings, as `args.style`: one of router.cli.findings.FORMATS."""
    styles = parser.add_mutually_exclusive_group()
    styles.set_defaults(style="text")
    for style, about in (("json", "JSON, for programs"), ("github", "annotations beside the lines of a pull request")):
        styles.add_argument(f"--{style}", dest="style", action="store_const", const=style, help=about)


def add_wire_options(parser: argparse.ArgumentParser) -> None:
    add_table(parser)
    parser.add_argument("--protos", type=Path, metavar="DIR", help="folder of .proto files, instead of a table")


def load_wire(args: argparse.Namespace, place: str = "") -> tuple[Wire, RouteTable | None]:
    """Return the messages, and the table if one is used. A `place` that is a name requires a table.

    Raises TableError or UsageError.
    """
    from router.datagrams import wire_of_protos, wire_of_table
    from router.table import read_table

    if args.protos is not None and args.table is not None:
        raise UsageError("--protos and --table both say where the messages are", "give only one")
    find = table_path if place.isidentifier() and place != "localhost" else table_if_any
    if args.protos is None and (path := find(args)) is not None:
        table = read_table(path)
        return wire_of_table(table), table
    try:
        return wire_of_protos(args.protos or asset("protos")), None
    except FileNotFoundError:
        raise UsageError(
            "this router has no protos of its own", "name a table (-t TABLE) or a folder (--protos DIR)"
        ) from None


def add_router_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that select a running router, by its table or by its URL."""
    add_table(parser)
    add_url_option(parser)


def add_url_option(parser: argparse.ArgumentParser) -> None:
    about = "URL of the running router, such as http://127.0.0.1:9108 (default: the table's 'http.address')"
    parser.add_argument("--url", metavar="URL", help=about)


def running_url(args: argparse.Namespace) -> str:
    """Return the URL from --url or from the table, which may have errors elsewhere. Raises TableError or UsageError."""
    if args.url:
        return str(args.url).strip()

    from router.table import http_address, load_table
    from router.tools.running_router import url_at, url_of

    path = table_path(args)
    if (address := http_address(path, inputs.ENVIRONMENT)) is not None:
        return url_at(address)
    table, findings = load_table(path)
    if table is None:
        raise TableError(findings)
    return url_of(table)


def add_for(
    parser: argparse.ArgumentParser, about: str = "stop after this time, for example 10s (default: at Ctrl-C)"
) -> None:
    """Add `--for DURATION`, as `args.seconds`."""
    parser.add_argument("--for", dest="seconds", type=seconds, metavar="DURATION", help=about)


def add_count(parser: argparse.ArgumentParser, about: str = "stop after N messages (default: at Ctrl-C)") -> None:
    parser.add_argument("--count", type=whole, metavar="N", help=about)


@contextmanager
def until_interrupted() -> Iterator[None]:
    """End the block at Ctrl-C or SIGTERM, without an error."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)


def print_batches(
    batches: Iterable[Sequence[TappedDatagram | ShownAction | TappedMessage]],
    args: argparse.Namespace,
    waited: float = 0.0,
) -> None:
    """Print until --count or --for is reached; `waited` seconds of --for are already over.

    Batches may be empty. Each is written with one system call: one per line would take longer than the rest.
    """
    left, until = args.count, time.monotonic() + (args.seconds or math.inf) - waited
    for batch in batches:
        if shown := batch[:left]:
            print("\n".join(item.json(args.hex) if args.json else item.line(args.hex) for item in shown), flush=True)
        if time.monotonic() >= until or (left is not None and (left := left - len(shown)) == 0):
            return


def seconds(text: str) -> float:
    """Parse a duration such as `10s` or `500ms`. Return seconds."""
    from router.table.units import parse_duration

    return _quantity(parse_duration, text, "s") / 1e9


def hertz(text: str) -> float:
    """Parse a rate such as `20Hz`. Return Hz."""
    from router.table.units import parse_rate

    return _quantity(parse_rate, text, "Hz")


def factor(text: str) -> float:
    """Parse a factor such as `2x`."""
    return _quantity(_parse_factor, text, "x")


def speed(text: str) -> float:
    """Parse a factor such as `2x`, or `max`, which is infinite."""
    return math.inf if text == "max" else factor(text)


def _parse_factor(text: str) -> float:
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)x", text)
    if match is None or not 0 < float(match[1]) <= 1e6:
        raise ValueError(f"'{text}' is not a speed such as 2x or 0.5x")
    return float(match[1])


_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")


def _quantity(parse: Callable[[str], float], text: str, unit: str) -> float:
    try:
        return parse(text)
    except ValueError as error:
        what, _, hint = str(error).partition("; ")
        number = _NUMBER.match(text)
        if number and float(number[0]) <= 0:
            what, hint = f"'{text}' is not above zero", ""
        elif number and number[0] == text:
            what, hint = f"'{text}' has no unit", f"did you mean '{text}{unit}'?"
        raise argparse.ArgumentTypeError(with_help(what, hint)) from error


def say(line: str) -> None:
    """Print a line to stderr; stdout is for the output of the verb."""
    print(line, file=sys.stderr, flush=True)


def integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number") from None


def whole(text: str) -> int:
    """Parse an integer above zero."""
    value = integer(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return value


@contextmanager
def progress(
    columns: Callable[[], Iterable[ProgressColumn]], total: int | None = None
) -> Iterator[Callable[..., None]]:
    """Show `columns` of rich on stderr if it is a terminal. Yields a function to update them: `update(completed=7)`."""
    if not sys.stderr.isatty():
        yield lambda **_: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(*columns(), console=Console(stderr=True), refresh_per_second=4, transient=True) as shown:
        task, last = shown.add_task("", total=total), dict[str, Any]()

        def update(**state: Any) -> None:
            nonlocal last
            if state != last:  # called for each datagram, mostly without a change
                last = state
                shown.update(task, **state)

        yield update

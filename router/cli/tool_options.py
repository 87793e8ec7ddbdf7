"""What the tools' verbs share: the options that find the envelope, and numbers in range. Knows no verb."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from router.assets import asset
from router.cli import BAD_USAGE, DEFAULT_TABLE
from router.errors import TransportError
from router.tools import UsageError

if TYPE_CHECKING:
    from router.table.model import RouteTable
    from router.tools.wire import Wire


def add_wire_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--table", type=Path, metavar="TABLE", help=f"route table (default: {DEFAULT_TABLE}, if there)")
    group.add_argument("--protos", type=Path, metavar="DIR", help="folder of .proto files, instead of a table")


def load_wire(args: argparse.Namespace) -> tuple[Wire, RouteTable | None]:
    """Raises TableError."""
    from router.tools.wire import read_table, wire_of_protos, wire_of_table

    if args.protos is None and (args.table is not None or DEFAULT_TABLE.exists()):
        table = read_table(args.table or DEFAULT_TABLE)
        return wire_of_table(table), table
    return wire_of_protos(args.protos or asset("protos")), None


def explained(run: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """A verb whose errors are one line: exit code 2 for what was typed, 1 for what the network did."""

    @functools.wraps(run)
    def explaining(args: argparse.Namespace) -> int:
        try:
            return run(args)
        except (UsageError, TransportError) as error:
            print(f"router {args.verb}: {error}", file=sys.stderr)
            return BAD_USAGE if isinstance(error, UsageError) else 1

    return explaining


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

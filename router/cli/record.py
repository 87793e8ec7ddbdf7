"""`router record`: write what a running router receives to a file, or make it save what it has kept in memory."""

from __future__ import annotations

import argparse
import math
import sys
from datetime import datetime, timezone
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

from router.cli import OK, Subparsers, add_verb
from router.cli.tool_options import add_for, add_router_options, progress, running_url, table_path, until_interrupted
from router.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.progress import ProgressColumn

    from router.tools.recordings import TapRecording

FAILED = 1


_DESCRIPTION = """Write every datagram that a running router receives to an MCAP file until Ctrl-C, with sender and
time. Rejected datagrams are included, with the reason. Foxglove opens the file; 'router replay' sends it again. To
record always, without this command, add 'record' to the table."""


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router record -o it.mcap --for 1min", "router record -t routes/sim.yaml", "router record --last")
    parser = add_verb(subparsers, "record", _DESCRIPTION, *examples)
    add_router_options(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: TABLE_TIME.mcap in this folder")
    parser.add_argument("--last", action="store_true", help="make the router save what it has kept in memory instead")
    add_for(parser)


def run(args: argparse.Namespace) -> int:
    if args.last and (args.output or args.seconds):
        where = "the directory of the table's 'record', on the router's computer"
        raise UsageError(f"--last writes to {where}", "leave out -o and --for")
    return _save_last(args) if args.last else _record(args)


def _save_last(args: argparse.Namespace) -> int:
    from router.tools.running_router import post

    answer = post(running_url(args), "/record/save", patience=60)
    if not answer.ok:
        print(f"router record: {answer.body.get('text', answer.body)}", file=sys.stderr)
        return FAILED
    print(answer.body["file"])
    return OK


def _record(args: argparse.Namespace) -> int:
    from router.datagrams import wire_of_table
    from router.table import read_table
    from router.threads import background_threads
    from router.tools.recordings import TapRecording
    from router.tools.running_router import tap

    table = read_table(table_path(args))
    url = running_url(args)
    time = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    # The router has priority over observers on its computer.
    with background_threads(), tap(url) as batches:
        recording = TapRecording(
            args.output or Path(f"{table.path.stem}_{time}.mcap"), wire_of_table(table).envelopes, table
        )
        print(f"recording the router at {url} to {recording.path}; press Ctrl-C to stop", file=sys.stderr, flush=True)
        try:
            with until_interrupted(), progress(_columns) as update:
                until = monotonic() + (args.seconds or math.inf)
                for batch in batches:  # at least one each second
                    recording.take(batch)
                    update(description=_summary(recording))
                    if monotonic() >= until:
                        break
        finally:
            recording.close()
            print(_summary(recording))
    return OK


def _summary(recording: TapRecording) -> str:
    missed = f", {recording.missed} missed" if recording.missed else ""
    return f"{recording.path}: {recording.datagrams} datagrams{missed}, {recording.size / 1e6:.2f} MB"


def _columns() -> Iterable[ProgressColumn]:
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    return (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))

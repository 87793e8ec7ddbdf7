"""`router record [TABLE]`: what a running router receives, to a file; or what it has kept in memory."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from router.cli import DEFAULT_TABLE, OK, VERBS
from router.cli.tool_options import explained
from router.tools import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from router.tools.recording_tap import TapRecording

FAILED = 1


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "record",
        help=VERBS["record"],
        description="Write every datagram that a running router receives to an MCAP file, until Ctrl-C: before it is "
        "routed, also what no route takes, with sender and time. Foxglove opens the file as it is, 'router replay' "
        "sends it again. To record always, without this command, give the table a 'record'.",
    )
    parser.add_argument(
        "table",
        nargs="?",
        type=Path,
        default=DEFAULT_TABLE,
        metavar="TABLE",
        help=f"the table that it runs, for its metrics.address (default: {DEFAULT_TABLE})",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: TABLE_TIME.mcap in this folder")
    parser.add_argument("--last", action="store_true", help="have the router save what it has kept in memory instead")
    parser.add_argument("--url", metavar="URL", help="of the running router (default: the table's metrics.address)")


@explained
def run(args: argparse.Namespace) -> int:
    if args.last and args.output:
        raise UsageError("--last writes to the directory of the table's 'record', on the router's computer; leave -o")
    return _save_last(args) if args.last else _record(args)


def _save_last(args: argparse.Namespace) -> int:
    from router.tools.running_router import post, url_of
    from router.tools.wire import read_table

    answer = post(args.url or url_of(read_table(args.table)), "/record/save", patience=60)
    if not answer.ok:
        print(f"router record: {answer.said.get('text', answer.said)}", file=sys.stderr)
        return FAILED
    print(answer.said["file"])
    return OK


def _record(args: argparse.Namespace) -> int:
    from router.edges.background import background_threads
    from router.tools.recording_tap import TapRecording
    from router.tools.running_router import tap, url_of
    from router.tools.wire import read_table, wire_of_table

    table = read_table(args.table)
    url = args.url or url_of(table)
    time = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    # The router goes before whatever runs on its computer to watch it.
    with background_threads(), tap(url) as batches:
        recording = TapRecording(
            args.output or Path(f"{table.path.stem}_{time}.mcap"), wire_of_table(table).envelope, table
        )
        print(f"recording the router at {url} to {recording.path}; Ctrl-C ends it", file=sys.stderr, flush=True)
        try:
            with _progress(recording) as tell:
                for batch in batches:
                    recording.take(batch)
                    tell()
        except KeyboardInterrupt:
            pass
        finally:
            recording.close()
            print(_told(recording))
    return OK


def _told(recording: TapRecording) -> str:
    missed = f", {recording.missed} missed" if recording.missed else ""
    return f"{recording.path}: {recording.datagrams} datagrams{missed}, {recording.size / 1e6:.2f} MB"


@contextmanager
def _progress(recording: TapRecording) -> Iterator[Callable[[], None]]:
    """A line that counts, where somebody looks."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=4, transient=True) as progress:
        task = progress.add_task("")
        yield lambda: progress.update(task, description=_told(recording))

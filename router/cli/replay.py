"""`router replay FILE`: send a recording again, or with `--against NEW` compare what two tables do with it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import TYPE_CHECKING

from router.cli import OK, Subparsers, add_verb, with_help
from router.cli.completion import completes, endpoints, places
from router.cli.tool_options import (
    add_table,
    good_table,
    progress,
    say,
    speed,
    table_if_any,
    table_path,
    until_interrupted,
)
from router.errors import UsageError

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from router.recording.reader import Recording
    from router.tools.recordings import Resent

DIFFERENT = 1

_DESCRIPTION = """\
Send the datagrams of a recording again, at the recorded intervals, to the listeners of the table and from the
addresses that the table has for their senders. For a serial line, be its other end, at a pty that the router can open;
over TCP, be the boards. With --against, send nothing: run them through the table and another one, and print what they
would deliver differently; exit code 1 if there is a difference.
"""

_EXAMPLES = (
    "router replay it.mcap -t routes/sim.yaml",
    "router replay it.mcap --speed max --to 127.0.0.1:5000 --from 127.0.0.30",
    "router replay it.mcap --against routes/new.yaml",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "replay", _DESCRIPTION, *_EXAMPLES)
    parser.add_argument("file", type=Path, metavar="FILE", help="recording that 'record' has written")
    about = "2x is twice as fast, max does not wait (default: 1x)"
    parser.add_argument("--speed", type=speed, metavar="SPEED", help=about)
    completes(
        parser.add_argument("--to", metavar="PLACE", help="HOST:PORT, or a name in the table (default: its listeners)"),
        places,
    )
    completes(
        parser.add_argument("--from", dest="origin", metavar="PLACE", help="HOST[:PORT], or an endpoint in the table"),
        endpoints,
    )
    add_table(parser)
    parser.add_argument("--against", type=Path, metavar="NEW", help="compare TABLE with this table instead")


def run(args: argparse.Namespace) -> int:
    from router.recording.reader import Recording

    if args.against is not None and (args.speed or args.to or args.origin):
        raise UsageError("--against sends nothing", "leave out --speed, --to and --from")
    with closing(Recording(args.file)) as recording:
        code = _compare(args, recording) if args.against is not None else _send(args, recording)
        if recording.ends_early:
            print(f"{args.file} was not finished: everything after its last complete chunk is missing", file=sys.stderr)
    return code


def _send(args: argparse.Namespace, recording: Recording) -> int:
    from router.table import read_table
    from router.tools import udp
    from router.tools.recordings import Replayer, on_time

    path = table_if_any(args)
    table = read_table(path) if path is not None else None
    to = udp.destination(args.to, table) if args.to else None
    origin = udp.origin(args.origin, table) if args.origin else None
    replayer = Replayer(table, to, origin)
    with until_interrupted(), closing(replayer), _progress(recording, "sending") as update:
        for end in replayer.ends:
            if not end.is_open:
                say(f"waiting for {end.awaited}; press Ctrl-C to stop")
            end.await_open()
        for datagram in on_time(recording, args.speed or 1.0):
            replayer.send(datagram)
            update(completed=recording.position)
    print(f"sent {replayer.resent.datagrams} datagrams")
    return _advise(replayer.resent)


def _advise(resent: Resent) -> int:
    """Print on stderr why the datagrams may have had no effect. Return 1 if the port was closed, else 0."""
    if resent.elsewhere:
        listed = ", ".join(f"{name} ({host})" for name, host in sorted(resent.elsewhere.items())[:5])
        more = f" and {len(resent.elsewhere) - 5} more" if len(resent.elsewhere) > 5 else ""
        what = f"router replay: this computer does not have the addresses of {listed}{more} and used its own"
        hint = "name a table that has local addresses for them (-t TABLE), or one address for all (--from PLACE)"
        print(with_help(f"{what}: to the router, they are strangers", hint), file=sys.stderr)
    if resent.refused:
        print("router replay: nobody listened for some of the datagrams", file=sys.stderr)
    return 1 if resent.refused else OK


def _compare(args: argparse.Namespace, recording: Recording) -> int:
    from router.compiler.lookup import Definitions
    from router.rehearsal.against import Against, Report

    definitions = Definitions()
    old, before = good_table(table_path(args), definitions=definitions)
    new, after = good_table(args.against, definitions=definitions)
    against = Against(before, after)
    with _progress(recording, "comparing") as update:
        for datagram in recording.datagrams():
            against.take(datagram)
            update(completed=recording.position)
    for line in Report(old, new).lines(against):
        print(line)
    return DIFFERENT if against.differs else OK


def _progress(recording: Recording, doing: str) -> AbstractContextManager[Callable[..., None]]:
    """Show the progress, in steps of a chunk, which is half a second."""

    def columns() -> Iterable[ProgressColumn]:
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        return (TextColumn(doing), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())

    return progress(columns, recording.size)

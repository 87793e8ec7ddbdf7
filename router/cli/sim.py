"""`router sim`: simulate all boards and the basestation of a table on this computer."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from typing import TYPE_CHECKING

from router.cli import Subparsers, add_verb
from router.cli.completion import completes, obedience, silences
from router.cli.tool_options import add_for, add_table, factor, good_table, integer, table_path

if TYPE_CHECKING:
    from router.tools.sim_view import SimView
    from router.tools.simulator import Simulator

TERMINAL_REFRESH = 0.5
JSON_REFRESH = 0.5
LINE_REFRESH = 5.0
CHANGE_REFRESH = 0.1
"""Seconds between two updates of what is shown."""

CHANGES_SHOWN = 3


_DESCRIPTION = """Send plausible, moving values from every endpoint of a table and show what each receives. Lists have
as many elements as the table's mappings need. Boards obey commands, halt when a deadman stops them, and stop after a
second without commands. Endpoints reply to the requests of services. The endpoints' addresses must belong to this
computer, as in routes/sim.yaml. A board on a serial line is at a pty, at the path of the device: nothing may be there.
Over TCP, boards accept the router or connect to it."""
_EXAMPLES = (
    "router sim -t routes/sim.yaml",
    "router sim -t routes/sim.yaml --silent basestation:5-8    # a lost link",
    "router sim -t routes/sim.yaml --obey driving_board:manual_drive",
    "router sim -t routes/sim.yaml --speed 10x --for 1min --json",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "sim", _DESCRIPTION, *_EXAMPLES)
    add_table(parser)
    add_for(parser)
    parser.add_argument("--seed", type=integer, default=1, metavar="N", help="the same seed sends the same values")
    parser.add_argument("--speed", type=factor, default=1.0, metavar="SPEED", help="2x sends twice as often")
    completes(
        parser.add_argument(
            "--silent",
            action="append",
            default=[],
            metavar="NAME:FROM-TO",
            help="send nothing from this endpoint, or of this payload case, from second FROM to second TO; without TO, "
            "to the end. May be repeated",
        ),
        silences,
    )
    completes(
        parser.add_argument(
            "--obey",
            action="append",
            default=[],
            metavar="NAME:CASE[,CASE]",
            help="this board obeys these payload cases only: it counts others as ignored, and does not stop by itself. "
            "May be repeated",
        ),
        obedience,
    )
    parser.add_argument("--json", action="store_true", help="print statistics as JSON lines; the last one is final")


def run(args: argparse.Namespace) -> int:
    from router.datagrams import Wire
    from router.tools.lengths import needed_lengths
    from router.tools.sim_view import SimView
    from router.tools.simulator import Simulator, parse_obedience, parse_silence

    silences = [parse_silence(text) for text in args.silent]
    obeys = parse_obedience(args.obey)
    checked, program = good_table(table_path(args))
    wire = Wire(program.envelopes)
    simulator = Simulator(
        wire,
        program.table,
        args.seed,
        args.speed,
        deadmen=program.deadmen,
        services=program.services,
        silences=silences,
        obeys=obeys,
        lengths=needed_lengths(checked.routes),
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: simulator.stop())
    view = SimView(wire, simulator.statistics)
    show = _show_json if args.json else _show_terminal if sys.stdout.isatty() else _show_lines
    try:
        show(simulator, view, args)
    finally:
        simulator.close()
    return 0


def _show_json(simulator: Simulator, view: SimView, args: argparse.Namespace) -> None:
    def write(seconds: float, final: bool) -> None:
        print(json.dumps(view.as_json(seconds, final)), flush=True)

    write(simulator.run(args.seconds, JSON_REFRESH, lambda seconds: write(seconds, False)), True)


def _show_lines(simulator: Simulator, view: SimView, args: argparse.Namespace) -> None:
    """Print a line every LINE_REFRESH seconds, and one for each change of a board."""
    shown, due = 0.0, LINE_REFRESH

    def write(seconds: float) -> None:
        nonlocal shown, due
        for change in view.changes(since=shown):
            print(change, flush=True)
        shown = seconds
        if seconds >= due:
            due += LINE_REFRESH
            view.update(seconds)
            print(view.line(), flush=True)

    print(f"{simulator.summary}; press Ctrl-C to stop", flush=True)
    seconds = simulator.run(args.seconds, CHANGE_REFRESH, write)
    due = seconds
    write(seconds)


def _show_terminal(simulator: Simulator, view: SimView, args: argparse.Namespace) -> None:
    """Draw on the whole screen, and leave the summary at the end."""
    from rich.console import Console, Group
    from rich.live import Live
    from rich.text import Text

    console = Console()
    with Live(console=console, screen=True, auto_refresh=False) as live:

        def draw(seconds: float) -> None:
            view.update(seconds)
            title = Text(f"{simulator.summary}; press Ctrl-C to stop", style="bold", no_wrap=True, overflow="ellipsis")
            statuses = view.statuses()
            changes = [Text(str(change), style="dim") for change in view.changes(since=0)[-CHANGES_SHOWN:]]
            room = console.height - 2 - statuses.row_count - len(changes)
            live.update(Group(title, view.headline(), statuses, view.table(room), *changes), refresh=True)

        seconds = simulator.run(args.seconds, TERMINAL_REFRESH, draw)
    view.update(seconds)
    console.print(view.table(1000))
    console.print(view.statuses())
    console.print(view.headline())

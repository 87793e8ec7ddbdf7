"""`router show FILE`: print a recording, or with `--why` explain each stop in it."""

from __future__ import annotations

import argparse
import datetime as dt
import heapq
import re
from collections.abc import Iterable, Iterator
from contextlib import closing
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from router.cli import OK, Subparsers, add_verb
from router.cli.tool_options import say, seconds
from router.errors import UsageError

if TYPE_CHECKING:
    from router.datagrams import Wire
    from router.recording.reader import Recorded, RecordedAction, Recording

Entry: TypeAlias = "Recorded | RecordedAction"

_DESCRIPTION = """Print a recording: what the router received, rejected and dropped, what it sent by itself, and when
deadman timers tripped. With --why, print for each of these when that was, why, and what last fed it. Neither the
table nor a running router is needed. Times are local, with milliseconds; times in file names are UTC."""
_EXAMPLES = (
    "router show it.mcap --why",
    "router show it.mcap --around 14:03",
    "router show it.mcap --case drive_motor --where 'left > 0' --json",
)
_MARGIN = 30.0
_BATCH = 500
_DISORDER = 1_000_000_000
"""ns by which entries of a recording may be out of order, at most; the mirror's PERIOD is much shorter."""

_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d)(\.\d+)?)?")
_SECONDS = re.compile(r"\d:\d\d:\d\d")


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "show", _DESCRIPTION, *_EXAMPLES)
    parser.add_argument("file", type=Path, metavar="FILE", help="recording of a router")
    parser.add_argument("--why", action="store_true", help="explain each stop instead")
    about = "only payloads of this case, received or sent; may be repeated"
    parser.add_argument("--case", dest="cases", action="append", default=[], metavar="CASE", help=about)
    about = "only payloads for which this expression is true: 'satellites < 4', 'envelope.seq > 9'"
    parser.add_argument("--where", metavar="EXPR", help=about)
    about = "only around this time: local, such as 14:03 or 14:03:07, or with date, such as 2026-04-12T14:03"
    parser.add_argument("--around", metavar="TIME", help=about)
    about = "how long before and after the time of --around (default: 30s)"
    parser.add_argument("--margin", type=seconds, metavar="DURATION", help=about)
    parser.add_argument("--json", action="store_true", help="one JSON object per line")


def run(args: argparse.Namespace) -> int:
    from router.datagrams import Wire
    from router.recording.reader import Recording
    from router.recording.schemas import recorded_envelopes

    if args.why and (args.cases or args.where):
        raise UsageError("--why explains whole stops", "leave out --case and --where")
    if args.margin is not None and args.around is None:
        raise UsageError("--margin is for --around", "give both")
    with closing(Recording(args.file)) as recording:
        wire = Wire(recorded_envelopes(recording.types(), recording.about))
        entries = in_order(recording.everything())
        first = next(entries, None)
        if first is None:
            say(f"{args.file} has no datagrams")
            return OK
        _say_what(recording, first)
        (_explain if args.why else _print)(args, recording, wire, chain([first], entries), first)
        if recording.ends_early:
            say(f"{args.file} was not finished: everything after its last complete chunk is missing")
    return OK


def in_order(entries: Iterable[Entry]) -> Iterator[Entry]:
    """Yield the entries in the order of time, without steps of the wall clock."""
    waiting: list[tuple[int, int, Entry]] = []
    for number, entry in enumerate(entries):
        heapq.heappush(waiting, (entry.steady, number, entry))
        while entry.steady - waiting[0][0] > _DISORDER:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def window(around: str, margin: float, first: int) -> tuple[int, int]:
    """Return begin and end (ns) of the time `around`, with `margin` seconds before and after it.

    It is a local time of day, or a date and time. Without seconds it is a whole minute. A time of day is the next one
    after `first`, the beginning of the recording (ns). Raises UsageError.
    """
    from router.tools.tap import local_time

    begin = local_time(first)
    try:
        if (time_of_day := _TIME_OF_DAY.fullmatch(around)) is not None:
            hour, minute, second = (int(part or 0) for part in time_of_day.groups()[:3])
            at = begin.replace(hour=hour, minute=minute, second=second, microsecond=0)
            has_seconds = time_of_day[3] is not None
            if at + dt.timedelta(minutes=1) < begin - dt.timedelta(seconds=margin):
                at += dt.timedelta(days=1)
        else:
            at = dt.datetime.fromisoformat(around.removesuffix("Z") + "+00:00" * around.endswith("Z")).astimezone()
            has_seconds = _SECONDS.search(around) is not None
    except ValueError:
        how = "give a local time such as 14:03 or 14:03:07, or a date and time such as 2026-04-12T14:03:07"
        raise UsageError(f"--around: '{around}' is not a time", how) from None
    start = int(at.timestamp() * 1e9)
    extra = int(margin * 1e9)
    return start - extra, start + (1 if has_seconds else 60) * 1_000_000_000 + extra


def _say_what(recording: Recording, first: Entry) -> None:
    from router.recording.about import tripped_in
    from router.tools.tap import local_time
    from router.values.printing import time_text

    begin = local_time(first.at)
    tripped = ", ".join(tripped_in(recording.about))
    why = f"saved because of {tripped}, " if tripped else ""
    offset = f"{begin:%z}"
    say(
        f"{recording.path}: {why}table {recording.about.get('table', 'unknown')}; "
        f"begins {begin:%Y-%m-%d} {time_text(begin)}, local time (UTC{offset[:3]}:{offset[3:]})"
    )


def _window(args: argparse.Namespace, first: Entry) -> tuple[int, int] | None:
    if args.around is None:
        return None
    return window(args.around, _MARGIN if args.margin is None else args.margin, first.at)


def _say_nothing(span: tuple[int, int], what: str, last: int) -> None:
    from router.tools.tap import local_time
    from router.values.printing import time_text

    begin, end, last_shown = (time_text(local_time(at)) for at in (*span, last))
    say(f"{what} between {begin} and {end}; the recording ends at {last_shown}")


def _print(args: argparse.Namespace, recording: Recording, wire: Wire, entries: Iterator[Entry], first: Entry) -> None:
    from router.recording.reader import RecordedAction
    from router.tools.tap import Condition, Filter, shown

    cases = [wire.case(name) for name in args.cases] or list(wire.envelopes.cases.values())
    if args.where and not cases:
        raise UsageError(f"{recording.path} has no payloads, so --where has none to look at")
    condition = Condition(args.where, wire.envelopes, cases) if args.where else None
    chosen, span = Filter(args.cases, condition), _window(args, first)
    last, count = first.at, 0

    def lines() -> Iterator[str]:
        nonlocal last
        for entry in entries:
            last = entry.at
            if span is None or span[0] <= entry.at <= span[1]:
                for each in shown(entry.action if isinstance(entry, RecordedAction) else entry, wire):
                    if chosen.takes(each, entry.at):
                        yield each.json(False) if args.json else each.line(False)

    printed = lines()
    while batch := [*islice(printed, _BATCH)]:
        count += len(batch)
        print("\n".join(batch), flush=True)
    if span is not None and not count:
        _say_nothing(span, "nothing to show", last)
    if condition is not None and condition.failure:
        say(f"payloads for which --where has no value are not shown: {condition.failure}")


def _explain(
    args: argparse.Namespace, recording: Recording, wire: Wire, entries: Iterator[Entry], first: Entry
) -> None:
    from router.recording.about import routes_of
    from router.tools.stops import Stops
    from router.tools.tap import shown

    stops, last, span = Stops(routes_of(recording.about), wire), first.at, _window(args, first)
    for entry in entries:
        stops.take(entry)
        last = entry.at
    stops.note_answers(recording.about.get("obeyed", ""))
    chosen = [stop for stop in stops.found if span is None or span[0] <= stop.at <= span[1]]
    for number, stop in enumerate(chosen):
        if args.json:
            print(stop.json())
        else:
            print("\n".join(([""] if number else []) + stop.lines()))
    for silence in stops.silences:
        if span is None or span[0] <= silence.at <= span[1]:
            for each in shown(silence, wire):
                print(each.json(False) if args.json else each.line(False))
    if not chosen and span is not None:
        _say_nothing(span, "no deadman tripped", last)
    elif not chosen and not stops.has_actions:
        say("this recording has no actions of the router: an earlier version made it, or nothing was sent")
    elif not chosen:
        say("no deadman tripped in this recording")

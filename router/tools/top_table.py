"""The routes of `router top` as a table that fits. rich shares the width among the columns; nothing is wrapped."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from router.compiler.metrics import INTENDED_REASONS, LATENCY_BOUNDS_NS
from router.table.units import duration
from router.tools.top import Order, RouteRow, TargetRow, View, ordered
from router.values.printing import age_text, rate_text, shortened

Cell = Callable[[RouteRow], Text]

LATENCIES_FROM = 100
"""Minimum width of a terminal, in columns, at which latencies are shown."""

_SHORT = 9
_SHORTEST = 4
"""Minimum letters shown of a target's name: with several targets, and with only one."""


_LATENCIES: dict[str, Cell] = {
    "p50": lambda row: Text(latency_text(row.median)),
    "p99": lambda row: Text(latency_text(row.slowest)),
}
_AGE: dict[str, Cell] = {"age": lambda row: Text(age_text(row.age), style="dim" if row.age is None else "")}


@dataclass(frozen=True, slots=True)
class RouteTable:
    """At most `height` lines with the routes in this order, from number `first` (counted from 0) on.

    `columns` are additional ones. Without any, the table shows ages, and latencies if there is room.
    """

    view: View
    order: Order
    height: int
    first: int = 0
    columns: Mapping[str, Cell] | None = None

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        columns = self.columns or (_LATENCIES if options.max_width >= LATENCIES_FROM else {}) | _AGE
        table = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("route", "in/s", "endpoints", "topics", *columns, "drops"):
            is_number = title == "in/s" or title in columns
            header = Text(title, no_wrap=True, overflow="ellipsis")
            table.add_column(header, justify="right" if is_number else "left", no_wrap=is_number)
        for row in ordered(self.view.routes, self.order)[self.shown.start : self.shown.stop]:
            table.add_row(
                _Fitted(partial(_name, row)),
                _rate(row.rate),
                _Fitted(partial(targets_text, [target for target in row.targets if not target.is_topic])),
                _Fitted(partial(targets_text, [target for target in row.targets if target.is_topic])),
                *(cell(row) for cell in columns.values()),
                _drops(row),
            )
        yield table

    @property
    def shown(self) -> range:
        """The numbers, in this order, of the routes that are shown. The last page is a full one."""
        count, room = len(self.view.routes), max(self.height - 1, 0)
        first = max(min(self.first, count - room), 0)
        return range(first, min(first + room, count))


@dataclass(frozen=True, slots=True)
class _Fitted:
    """A cell whose text depends on the width of its column."""

    text: Callable[[int], Text]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self.text(options.max_width)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(1, len(self.text(sys.maxsize))).with_maximum(options.max_width)


def _name(row: RouteRow, width: int) -> Text:
    """Return the name, with a `!` while its deadman sends."""
    name = f"!{row.route}" if row.is_tripped else row.route
    return Text(shortened(name, width), style="bold red" if row.is_tripped else "")


def targets_text(targets: Sequence[TargetRow], width: int) -> Text:
    """Return each target with its rate; those that lose messages now come first, with a `!`.

    If that is too wide, names are shortened, and then the last targets are only counted.
    """
    targets = sorted(targets, key=lambda target: not target.is_losing)
    text = Text()
    longest = max((len(target.name) for target in targets), default=0)
    for count in range(len(targets), 0, -1):
        least = _SHORT if count > 1 else _SHORTEST
        for letters in range(longest, min(longest, least) - 1, -1):
            text = Text("  ").join(_target(target, shortened(target.name, letters)) for target in targets[:count])
            if count < len(targets):
                text.append(f"  +{len(targets) - count}", style="dim")
            if len(text) <= width:
                return text
    text.truncate(width, overflow="ellipsis")
    return text


def _target(target: TargetRow, name: str) -> Text:
    mark = "!" if target.is_losing else ""
    return Text(f"{mark}{name} ", style=_style(target)).append_text(_rate(target.rate))


def _style(target: TargetRow) -> str:
    if target.is_losing:
        return "bold red"
    if not target.rate:
        return "dim"
    return "green" if target.is_topic else "cyan"


def _rate(rate: float) -> Text:
    return Text(rate_text(rate), style="" if rate else "dim")


def _drops(row: RouteRow) -> Text:
    """Return the drops: red and with a `!` while messages are lost; yellow if some were lost before.

    A route whose deadman sends may drop nothing because it receives nothing.
    """
    text, style = reasons_text(row.dropped) or "-", "yellow" if row.lost else "dim"
    if row.is_tripped and not row.rate and not row.dropped:
        text, style = "none accepted", "red"
    if row.is_losing:
        text, style = f"!{text}", "bold red"
    return Text(text, style=style, no_wrap=True, overflow="ellipsis")


def reasons_text(dropped: Mapping[str, int]) -> str:
    """Return `12 stale, 3 queue_full`, the largest first, and intended losses last."""
    by_count = sorted(dropped.items(), key=lambda item: (item[0] in INTENDED_REASONS, -item[1], item[0]))
    return ", ".join(f"{count} {reason}" for reason, count in by_count)


def latency_text(seconds: float | None) -> str:
    """Return `35 us` or `1.2 ms`; `-` for None."""
    if seconds is None:
        return "-"
    if math.isinf(seconds):
        return f"> {duration(LATENCY_BOUNDS_NS[-1])}"
    return f"{seconds * 1e6:.0f} us" if seconds < 1e-3 else f"{seconds * 1e3:.1f} ms"

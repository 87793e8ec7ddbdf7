"""How `router top` looks on a terminal and in a file, and the keys that it takes."""

from __future__ import annotations

import math
import os
import select
import sys
import termios
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS
from router.table.units import duration
from router.tools.top import Order, RouteRow, TargetRow, View, ordered, unwanted
from router.values import rate_text

Column = Callable[[RouteRow], Text]
"""One more cell for a route."""

_HEAD = 4
"""Lines above the routes and the one below them."""


@contextmanager
def keys() -> Iterator[Callable[[float], str]]:
    """Yield a function that waits for a key, at most so many seconds, and returns it or "".

    Until the context ends, keys come without Enter and are not echoed. Without a terminal there are none.
    """
    if not sys.stdin.isatty():
        yield _sleep
        return
    terminal = sys.stdin.fileno()
    readable = select.poll()
    readable.register(terminal, select.POLLIN)

    def wait(seconds: float) -> str:
        return os.read(terminal, 1).decode(errors="replace") if readable.poll(seconds * 1000) else ""

    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield wait
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _sleep(seconds: float) -> str:
    time.sleep(seconds)
    return ""


def screen(view: View, title: str, order: Order, height: int, note: str = "") -> RenderableType:
    """At most `height` lines. `note` says what went wrong when the router was last asked."""
    hints = ", ".join(f"{each.key} {each.value}" for each in Order)
    foot = Text(f"sorted by {order.value}; keys: {hints}, q quit", style="dim", no_wrap=True, overflow="ellipsis")
    head = Text(title, style="bold", no_wrap=True, overflow="ellipsis")
    if note:
        head.append(f"  {note}", style="bold red")
    return Group(head, *_summary(view), route_table(view, order, height - _HEAD, _TIMES), foot)


def page(view: View, order: Order) -> RenderableType:
    """All of it, to be printed once."""
    return Group(*_summary(view), route_table(view, order, len(view.routes) + 1, _TIMES))


def _summary(view: View) -> list[Text]:
    """The whole router in a line, and the endpoints, with the deadmen that send, in another."""
    about = Text(no_wrap=True, overflow="ellipsis")
    for row in view.routes:
        if row.is_tripped:
            about.append(f"deadman of {row.route} sends  ", style="bold red")
    if view.silence:
        about.append("last heard: ", style="dim")
    about.append(", ".join(f"{name} {age_text(seconds)}" for name, seconds in view.silence.items()), style="cyan")
    return [Text(summary_line(view), no_wrap=True, overflow="ellipsis"), about]


def route_table(view: View, order: Order, height: int, columns: Mapping[str, Column]) -> Table:
    """At most `height` lines with the first routes in this order; the last line counts the others."""
    table = Table(box=None, pad_edge=False, expand=True, header_style="bold")
    table.add_column("route", no_wrap=True)
    table.add_column("in/s", justify="right", no_wrap=True)
    table.add_column("delivered per second", no_wrap=True, ratio=1, overflow="ellipsis")
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("drops", no_wrap=True, overflow="ellipsis")
    rows, room = ordered(view.routes, order), height - 1
    shown = rows if len(rows) <= room else rows[: max(room - 1, 0)]
    for row in shown:
        rate = Text(rate_text(row.rate), style="" if row.rate else "dim")
        drops = Text(reasons_text(row.dropped) or "-", style="red" if row.lost else "dim")
        table.add_row(row.route, rate, _targets_cell(row), *(column(row) for column in columns.values()), drops)
    if len(shown) < len(rows):
        table.add_row(Text(f"and {len(rows) - len(shown)} more", style="dim"))
    return table


def _targets_cell(row: RouteRow) -> Text:
    """Destinations in cyan, topics in green, dim while nothing flows."""
    cell = Text()
    for target in row.targets:
        cell.append(f"{target.name} ", style=_style(target))
        cell.append(f"{rate_text(target.rate)}  ", style="" if target.rate else "dim")
    return cell


def _style(target: TargetRow) -> str:
    if target.lost:
        return "red"
    if not target.rate:
        return "dim"
    return "green" if target.is_topic else "cyan"


def summary_line(view: View) -> str:
    """The whole router in one line."""
    delivered = sum(target.delivered for row in view.routes for target in row.targets)
    rate = sum(target.rate for row in view.routes for target in row.targets)
    gone = Counter(view.rejected)
    for row in view.routes:
        gone.update(row.dropped)
    lost = unwanted(gone)
    wanted = {reason: count for reason, count in gone.items() if reason not in lost}
    if view.kernel_drops:
        lost["kernel_drops"] = view.kernel_drops
    return (
        f"in {view.received} ({rate_text(view.rate)}/s), delivered {delivered} ({rate_text(rate)}/s), "
        f"lost {reasons_text(lost) or 'none'}{'; as the table wants ' if wanted else ''}{reasons_text(wanted)}"
    )


def reasons_text(dropped: Mapping[str, int]) -> str:
    """`12 stale, 3 queue_full`, the largest first."""
    by_count = sorted(dropped.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} {reason}" for reason, count in by_count)


def age_text(seconds: float | None) -> str:
    """`0.3 s`, `12 s`, `7 min`, `3 h`; `never` for None."""
    if seconds is None:
        return "never"
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def latency_text(seconds: float | None) -> str:
    """`35 us`, `1.2 ms`; `-` for None."""
    if seconds is None:
        return "-"
    if math.isinf(seconds):
        return f"> {duration(HISTOGRAM_BOUNDS_NS[-1])}"
    return f"{seconds * 1e6:.0f} us" if seconds < 1e-3 else f"{seconds * 1e3:.1f} ms"


_TIMES: Mapping[str, Column] = {
    "age": lambda row: Text(age_text(row.age), style="dim" if row.age is None else ""),
    "p50": lambda row: Text(latency_text(row.median)),
    "p99": lambda row: Text(latency_text(row.slowest)),
}

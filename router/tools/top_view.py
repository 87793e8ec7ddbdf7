"""The display of `router top` on a terminal and in a file, and its keys.

rich shares the width of the table of routes among its columns; nothing in it is wrapped.
"""

from __future__ import annotations

import math
import os
import select
import sys
import termios
import textwrap
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from router.compiler.metrics import INTENDED_REASONS, LATENCY_BOUNDS_NS
from router.observe.states import StateReading
from router.table.units import duration
from router.tools.top import Order, RouteRow, TargetRow, View, ordered, unwanted
from router.values.printing import age_text, rate_text, shortened

_ENDPOINT_LINES = 4
"""Maximum lines of endpoints on a screen; silent endpoints are also among the problems above."""

_STYLES = {"!": "bold red", "□": "dim"}
"""Of problems by their sign; the second one is of what is inactive because nobody drives."""

_LETTERS = 24
"""Maximum letters of an endpoint's name."""

_SCROLLING = {"[A": "up", "[B": "down", "[5~": "page up", "[6~": "page down", "[H": "home", "[F": "end"}
_ESCAPE = "\x1b"


@contextmanager
def keys() -> Iterator[Callable[[float], str]]:
    """Yield a function that waits for a key, up to a number of seconds, and returns it (`q`, `page down`) or "".

    Until the context ends, keys come without Enter and are not echoed. Without a terminal there are none.
    """
    if not sys.stdin.isatty():
        yield _sleep
        return
    terminal = sys.stdin.fileno()
    readable = select.poll()
    readable.register(terminal, select.POLLIN)

    def wait(seconds: float) -> str:
        if not readable.poll(seconds * 1000):
            return ""
        key = os.read(terminal, 1).decode(errors="replace")
        if key != _ESCAPE or not readable.poll(0):  # a terminal sends the whole sequence of a key at once
            return key
        sequence = os.read(terminal, 2).replace(b"O", b"[")
        while sequence[-1:].isdigit() and readable.poll(0):
            sequence += os.read(terminal, 1)
        return _SCROLLING.get(sequence.decode(errors="replace"), "")

    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield wait
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _sleep(seconds: float) -> str:
    time.sleep(seconds)
    return ""


@dataclass(frozen=True, slots=True)
class Screen:
    """At most `height` lines. `note` is the error of the last request to the router.

    Routes are shown from number `first` on, as far as there is room for them.
    """

    view: View
    title: str
    order: Order
    height: int
    note: str = ""
    first: int = 0

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        title = Text(self.title, style="bold", no_wrap=True, overflow="ellipsis")
        if self.note:
            title.append(f"  {self.note}", style="bold red")
        yield title
        yield from self._head(options.max_width)
        table = self.table(options.max_width)
        yield table
        yield _foot(table)

    def table(self, width: int) -> RouteTable:
        room = self.height - len(self._head(width)) - 2
        return RouteTable(self.view, self.order, room, self.first)

    def _head(self, width: int) -> list[Text]:
        return _summary(self.view, width, max(self.height // 5, 1), min(_ENDPOINT_LINES, max(self.height // 6, 1)))

    def moved(self, key: str, width: int) -> int:
        """Return the number of the first route after a key was pressed."""
        shown, last = self.table(width).shown, len(self.view.routes)
        steps = {"up": -1, "down": 1, "page up": -len(shown), "page down": len(shown), "home": -last, "end": last}
        return max(shown.start + steps.get(key, 0), 0)


@dataclass(frozen=True, slots=True)
class Page:
    """The whole display, to be printed once."""

    view: View
    title: str
    order: Order

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.title, style="bold", no_wrap=True, overflow="ellipsis")
        yield from _summary(self.view, options.max_width, sys.maxsize, sys.maxsize)
        yield RouteTable(self.view, self.order, len(self.view.routes) + 1)


def _foot(table: RouteTable) -> Text:
    foot = Text(style="dim", no_wrap=True, overflow="ellipsis")
    shown, count = table.shown, len(table.view.routes)
    if len(shown) < count:
        foot.append(f"{shown.start + 1}-{shown.stop} of {count} ↑↓  ", style="bold")
    foot.append("sort:")
    for order in Order:
        is_chosen = order is table.order
        name = f"{order.key} {order.value}"
        foot.append(f" [{name}]" if is_chosen else f"  {name}", style="bold not dim" if is_chosen else "")
    return foot.append("  q quit")


def _summary(view: View, width: int, problem_lines: int, endpoint_lines: int) -> list[Text]:
    """Return the whole router in a line or two, what is wrong with it, and when its endpoints were last heard."""
    flow, losses = _summary_parts(view)
    whole = f"{flow}, {losses}"
    totals = [whole] if len(whole) <= width else [flow, losses]
    lines = [Text(line, no_wrap=True, overflow="ellipsis") for line in totals]
    lines += _problems(view, width, problem_lines)
    lines += [*_states(view, width, endpoint_lines), *_services(view, width, endpoint_lines)]
    return [*lines, *_last_heard(view, width, endpoint_lines)]


def _problems(view: View, width: int, most: int) -> list[Text]:
    """Return the problems below each other, wrapped at words; those that do not fit are counted."""
    told = [*(("!", text) for text in view.problems), *(("□", text) for text in view.calm)]
    lines = [
        (number, sign, line)
        for number, (sign, text) in enumerate(told, 1)
        for line in textwrap.wrap(f"{sign} {text}", width, subsequent_indent="  ", break_on_hyphens=False)
    ]
    if len(lines) > most:
        lines = lines[: max(most - 1, 1)]
        if (more := len(told) - lines[-1][0]) and most > 1:
            sign, _ = told[-more]
            lines.append((len(told), sign, f"{sign} and {more} more: see `router doctor`"))
    return [Text(line, style=_STYLES[sign], no_wrap=True, overflow="ellipsis") for _, sign, line in lines]


def _states(view: View, width: int, most: int) -> list[Text]:
    return _columns("state", [_state(each) for each in view.states], width, most)


def _state(state: StateReading) -> Text:
    return Text.assemble(f"{state.name} ", (state.value, "cyan"), (f", {state.origin}", "dim"))


def _services(view: View, width: int, most: int) -> list[Text]:
    return _columns("service", [Text(f"{each.name}: {each.text}") for each in view.services], width, most)


def _last_heard(view: View, width: int, most: int) -> list[Text]:
    return _columns("last heard", [_heard(*each, each[0] in view.silent) for each in view.silence.items()], width, most)


def _columns(title: str, items: list[Text], width: int, most: int) -> list[Text]:
    """Return items below each other, in as many lines as they need; those that do not fit are counted."""
    title, gap = f"{title:<12}", "  "
    longest = max(map(len, items), default=0)
    columns = max((width - len(title) + len(gap)) // (longest + len(gap)), 1)
    if (hidden := len(items) - columns * most) > 0:
        items[columns * most - 1 :] = [Text(f"and {hidden + 1} more", style="dim")]
    for item in items:
        item.pad_right(longest - len(item))
    lines = [Text(gap).join(items[start : start + columns]) for start in range(0, len(items), columns)]
    heads = [Text(title if index == 0 else " " * len(title), style="bold") for index in range(len(lines))]
    return [Text.assemble(*both, no_wrap=True, overflow="ellipsis") for both in zip(heads, lines, strict=True)]


def _heard(name: str, age: float | None, is_silent: bool) -> Text:
    """Return text of constant width, so that nothing moves while ages change."""
    text = Text(f"{shortened(name, _LETTERS)} ")
    if is_silent:
        text = Text(f"!{text.plain}", style="bold red")
    return text.append(f"{age_text(age):>5}", style="dim" if age is None else "cyan" if not is_silent else "")


def summary_line(view: View) -> str:
    """Return the whole router in one line."""
    return ", ".join(_summary_parts(view))


def _summary_parts(view: View) -> tuple[str, str]:
    """Return the messages received and delivered, and those lost."""
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
        f"in {view.received} ({rate_text(view.rate)}/s), delivered {delivered} ({rate_text(rate)}/s)",
        f"lost {reasons_text(lost) or 'none'}{'; as the table wants ' if wanted else ''}{reasons_text(wanted)}",
    )


# The table of routes

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

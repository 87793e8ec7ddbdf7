"""The routes of `router top` as a table that fits: names are shortened and columns left out, nothing is wrapped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from router.tools.top import Order, RouteRow, TargetRow, View, ordered
from router.tools.top_words import reasons_text
from router.values import rate_text, shortened

Cell = Callable[[RouteRow], Text]

_GAP = 2
_SHORT = 9
_SHORTEST = 4
"""Letters that are left of the name of a target at least, of several and of the only one shown."""

_SHRINKING = (
    *(("topics", 30), ("endpoints", 24), ("route", 20), ("topics", 18), ("endpoints", 16), ("drops", 12)),
    *(("route", 16), ("topics", 12), ("endpoints", 12), ("drops", 8), ("route", 8), ("endpoints", 8), ("drops", 5)),
)
"""What becomes narrower where there is no room, and to how many columns, one after the other."""

_WANTED = {"topics": 18, "endpoints": 24, "route": 20, "drops": 12}
"""Columns that are not shrunk further as long as another column can be left out."""


@dataclass(frozen=True, slots=True)
class Column:
    """One more cell for each route. Where there is no room, optional columns are left out, the first of them first."""

    title: str
    cell: Cell
    is_optional: bool = False


@dataclass(frozen=True, slots=True)
class RouteTable:
    """At most `height` lines with the routes in this order, from number `first` (counted from 0) on."""

    view: View
    order: Order
    height: int
    columns: Sequence[Column] = ()
    first: int = 0

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        shown = self.shown
        columns, widths = _fitted(self.view.routes, self.columns, options.max_width)
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("route", no_wrap=True, width=widths["route"])
        table.add_column("in/s", justify="right", no_wrap=True, width=widths["in/s"])
        table.add_column("endpoints", no_wrap=True, width=widths["endpoints"])
        table.add_column("topics", no_wrap=True, width=widths["topics"])
        for column in columns:
            table.add_column(column.title, justify="right", no_wrap=True, width=widths[column.title])
        table.add_column("drops", no_wrap=True, overflow="ellipsis", width=widths["drops"])
        for row in ordered(self.view.routes, self.order)[shown.start : shown.stop]:
            table.add_row(
                Text(shortened(_name(row), widths["route"]), style="bold red" if row.is_tripped else ""),
                _rate(row.rate),
                targets_text(_endpoints(row), widths["endpoints"]),
                targets_text(_topics(row), widths["topics"]),
                *(column.cell(row) for column in columns),
                _drops(row),
            )
        yield table

    @property
    def shown(self) -> range:
        """The routes that are shown, by their number in this order. The last page is a full one."""
        count, room = len(self.view.routes), max(self.height - 1, 0)
        first = max(min(self.first, count - room), 0)
        return range(first, min(first + room, count))


def _fitted(
    rows: Sequence[RouteRow], extra: Sequence[Column], width: int
) -> tuple[Sequence[Column], Mapping[str, int]]:
    """The further columns that have room, and how wide each column is."""
    widths = {
        "route": _widest("route", map(_name, rows)),
        "in/s": _widest("in/s", (rate_text(row.rate) for row in rows)),
        "endpoints": _widest("endpoints", (targets_text(_endpoints(row)).plain for row in rows)),
        "topics": _widest("topics", (targets_text(_topics(row)).plain for row in rows)),
        "drops": _widest("drops", (_drops(row).plain for row in rows)),
        **{column.title: _widest(column.title, (column.cell(row).plain for row in rows)) for column in extra},
    }
    columns = list(extra)
    floor = {name: min(width, _WANTED.get(name, width)) for name, width in widths.items()}
    for column in extra:
        if column.is_optional and _total(floor) > width:
            columns.remove(column)
            del widths[column.title], floor[column.title]
    for name, least in _SHRINKING:
        over = max(_total(widths) - width, 0)
        widths[name] -= min(over, max(widths[name] - least, 0))
    return columns, widths


def _widest(title: str, texts: Iterator[str]) -> int:
    return max(len(title), *map(len, texts), 0)


def _total(widths: Mapping[str, int]) -> int:
    return sum(widths.values()) + _GAP * (len(widths) - 1)


def _name(row: RouteRow) -> str:
    """With a `!` while its deadman sends."""
    return f"!{row.route}" if row.is_tripped else row.route


def _endpoints(row: RouteRow) -> list[TargetRow]:
    return [target for target in row.targets if not target.is_topic]


def _topics(row: RouteRow) -> list[TargetRow]:
    return [target for target in row.targets if target.is_topic]


def targets_text(targets: Sequence[TargetRow], width: int | None = None) -> Text:
    """Each with its rate, and with `!` while it loses messages.

    Where that is too wide, names are shortened, and then the last targets only counted.
    """
    longest = max((len(target.name) for target in targets), default=0)
    if width is None or not targets:
        return _targets(targets, len(targets), longest)
    others = [len(_target(target, "")) + len("  ") for target in targets]
    for count in range(len(targets), 0, -1):
        room = width - sum(others[:count]) + len("  ") - len(_others(targets, count))
        least = _SHORT if count > 1 else _SHORTEST
        for letters in range(longest, min(longest, least) - 1, -1):
            if sum(min(len(target.name), letters) for target in targets[:count]) <= room:
                return _targets(targets, count, letters)
    text = _targets(targets, 1, _SHORTEST)
    text.truncate(width, overflow="ellipsis")
    return text


def _others(targets: Sequence[TargetRow], count: int) -> str:
    return f"  +{len(targets) - count}" if count < len(targets) else ""


def _targets(targets: Sequence[TargetRow], count: int, letters: int) -> Text:
    cell = Text("  ").join(_target(target, shortened(target.name, letters)) for target in targets[:count])
    return cell.append(_others(targets, count), style="dim")


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
    """Red and with a `!` while it goes on; yellow where messages were lost before."""
    if row.is_losing:
        return Text(f"!{reasons_text(row.dropped)}", style="bold red")
    return Text(reasons_text(row.dropped) or "-", style="yellow" if row.lost else "dim")

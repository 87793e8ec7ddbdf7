"""How the rows of `live` look: a table for a terminal, one line for a log.

A terminal shows one line for each route, the troubled ones first when not all of them fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

from rich.table import Table
from rich.text import Text

from router.tools.live import RouteRow, TargetRow, View, unwanted
from router.values import rate_text

Column = Callable[[RouteRow], Text]
"""One more cell for a route, from whoever knows more than the metrics."""


def reasons_text(dropped: Mapping[str, int]) -> str:
    """`12 stale, 3 queue_full`, the largest first."""
    ordered = sorted(dropped.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} {reason}" for reason, count in ordered)


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


def route_table(view: View, height: int, columns: Mapping[str, Column] | None = None) -> Table:
    """At most `height` lines; what does not fit is counted in the last one."""
    columns = columns or {}
    table = Table(box=None, pad_edge=False, expand=True, header_style="bold")
    table.add_column("route", no_wrap=True)
    table.add_column("in/s", justify="right", no_wrap=True)
    table.add_column("delivered per second", no_wrap=True, ratio=1, overflow="ellipsis")
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("drops", no_wrap=True, overflow="ellipsis")
    room = height - 1
    shown = list(view.routes)
    if len(shown) > room:
        shown = sorted(shown, key=lambda row: (not row.lost, -row.rate))[: max(room - 1, 0)]
    for row in shown:
        cells = [column(row) for column in columns.values()]
        table.add_row(row.route, _rate_cell(row.rate), _targets_cell(row), *cells, _drops_cell(row))
    if len(shown) < len(view.routes):
        table.add_row(Text(f"and {len(view.routes) - len(shown)} more", style="dim"))
    return table


def _rate_cell(rate: float) -> Text:
    return Text(rate_text(rate), style="" if rate else "dim")


def _drops_cell(row: RouteRow) -> Text:
    return Text(reasons_text(row.dropped) or "-", style="red" if row.lost else "dim")


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

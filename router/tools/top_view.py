"""How `router top` looks: a headline, who is silent, one line for each route that fits.

Knows no HTTP and no keys; what is shown is made by `top`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from rich.console import Group, RenderableType
from rich.text import Text

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS
from router.table.quantities import duration
from router.tools.live import RouteRow
from router.tools.live_view import Column, route_table, summary_line
from router.tools.top import Order, Top, TopRow

_HEAD = 4
"""Lines above the routes and the one below them."""


def screen(shown: Top, title: str, order: Order, height: int, note: str = "") -> RenderableType:
    """At most `height` lines. `note` says what went wrong with the last look."""
    keys = ", ".join(f"{each.key} {each.value}" for each in Order)
    foot = Text(f"sorted by {order.value}; keys: {keys}, q quit", style="dim", no_wrap=True, overflow="ellipsis")
    head = Text(title, style="bold", no_wrap=True, overflow="ellipsis")
    if note:
        head.append(f"  {note}", style="bold red")
    return Group(head, *_told(shown), routes(shown, height - _HEAD), foot)


def page(shown: Top) -> RenderableType:
    """All of it, for whom it is shown once."""
    return Group(*_told(shown), routes(shown, len(shown.rows) + 1))


def routes(shown: Top, height: int) -> RenderableType:
    """The rows in their order. What does not fit is counted in the last line."""
    room = height - 1
    rows = shown.rows if len(shown.rows) <= room else shown.rows[: max(room - 1, 0)]
    by_name = {row.row.route: row for row in rows}
    table = route_table(replace(shown.view, routes=tuple(row.row for row in rows)), len(rows) + 1, _columns(by_name))
    if len(rows) < len(shown.rows):
        table.add_row(Text(f"and {len(shown.rows) - len(rows)} more", style="dim"))
    return table


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


def _told(shown: Top) -> list[Text]:
    """The whole router in a line, and the endpoints, with the deadmen that send, in another."""
    about = Text(no_wrap=True, overflow="ellipsis")
    for row in shown.rows:
        if row.is_tripped:
            about.append(f"deadman of {row.row.route} sends  ", style="bold red")
    if shown.silence:
        about.append("last heard: ", style="dim")
    about.append(", ".join(f"{name} {age_text(seconds)}" for name, seconds in shown.silence.items()), style="cyan")
    return [Text(summary_line(shown.view), no_wrap=True, overflow="ellipsis"), about]


def _columns(rows: Mapping[str, TopRow]) -> Mapping[str, Column]:
    def age(row: RouteRow) -> Text:
        seconds = rows[row.route].age
        return Text(age_text(seconds), style="dim" if seconds is None else "")

    def median(row: RouteRow) -> Text:
        return Text(latency_text(rows[row.route].median))

    def slowest(row: RouteRow) -> Text:
        return Text(latency_text(rows[row.route].slowest))

    return {"age": age, "p50": median, "p99": slowest}

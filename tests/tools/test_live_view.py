from __future__ import annotations

import io

from rich.console import Console
from rich.text import Text

from router.tools.live import RouteRow, TargetRow, View
from router.tools.live_view import reasons_text, route_table, summary_line


def row(route: str, rate: float = 5.0, dropped: dict[str, int] | None = None) -> RouteRow:
    targets = (
        TargetRow("basestation", False, 10, rate, {}, 0),
        TargetRow(f"{route}_topic", True, 10, rate, dropped or {}, 0),
    )
    return RouteRow(route, 10, rate, targets)


def seen(*rows: RouteRow) -> View:
    return View(rows, received=20, rate=10.0, rejected={"malformed": 2}, kernel_drops=0)


def lines(view: View, height: int, width: int = 80) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=width).print(route_table(view, height, {"seen": lambda row: Text(str(row.received))}))
    return out.getvalue().splitlines()


def test_one_line_for_each_route_under_a_header() -> None:
    header, imu, gps = lines(seen(row("imu"), row("gps", dropped={"stale": 3})), height=10)
    assert header.split() == ["route", "in/s", "delivered", "per", "second", "seen", "drops"]
    assert imu.split() == ["imu", "5.0", "basestation", "5.0", "imu_topic", "5.0", "10", "-"]
    assert gps.rstrip().endswith("10  3 stale")


def test_a_low_terminal_shows_troubled_routes_first_and_counts_the_others() -> None:
    shown = lines(seen(row("a"), row("b"), row("c", dropped={"stale": 1}), row("d")), height=4)
    assert len(shown) == 4
    assert shown[1].startswith("c")
    assert shown[3].startswith("and 2 more")


def test_a_line_never_gets_wider_than_the_terminal() -> None:
    assert all(len(line) <= 60 for line in lines(seen(row("a" * 20, dropped={"queue_full": 1})), height=9, width=60))


def test_the_summary_adds_everything_up() -> None:
    line = summary_line(seen(row("imu"), row("gps", dropped={"stale": 3})))
    assert line == "in 20 (10/s), delivered 40 (20/s), lost 3 stale, 2 malformed"


def test_what_the_table_wants_gone_is_told_apart_and_troubles_nobody() -> None:
    line = summary_line(seen(row("imu", dropped={"stale": 3, "rate_limited": 8})))
    assert line == "in 20 (10/s), delivered 20 (10/s), lost 3 stale, 2 malformed; as the table wants 8 rate_limited"
    shown = lines(seen(row("a"), row("b", dropped={"rate_limited": 1}), row("c", dropped={"stale": 1})), height=3)
    assert shown[1].startswith("c")


def test_reasons_are_in_order_of_their_number() -> None:
    assert reasons_text({"stale": 1, "queue_full": 3, "loop": 1}) == "3 queue_full, 1 loop, 1 stale"

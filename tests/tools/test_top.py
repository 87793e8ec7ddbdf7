"""`router top` tells ages and latencies as Prometheus would, in the order that is asked for."""

from __future__ import annotations

import math

import pytest
from rich.console import Console
from rich.text import Text

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS
from router.observe.snapshot import Snapshot, parse_metrics
from router.tools.top import WINDOW, Order, RouteRow, TargetRow, View, Window, ordered, quantile, view
from router.tools.top_view import age_text, latency_text, page, reasons_text, route_table, screen, summary_line

BOUNDS = (*(f"{bound / 1e9:g}" for bound in HISTOGRAM_BOUNDS_NS), "+Inf")
NOW = 1_000_000.0


def buckets(route: str, *counts: int) -> dict[tuple[str, ...], float]:
    """Cumulative; the last count holds for all further bounds."""
    padded = [*counts, *[counts[-1]] * (len(BOUNDS) - len(counts))]
    return {(route, bound): float(count) for bound, count in zip(BOUNDS, padded, strict=True)}


def snapshot(at: float, imu: int, gps: int, stale: int = 0, tripped: int = 0) -> Snapshot:
    return Snapshot(
        at,
        {
            "messages_received": {("imu_info", "sensor_board"): imu, ("gps_info", "sensor_board"): gps},
            "datagrams_sent": {("imu_info", "basestation"): imu, ("gps_info", "basestation"): gps},
            "messages_dropped": {("gps_info", "basestation", "stale"): stale},
            "route_last_message_timestamp_seconds": {("imu_info",): NOW - 5, ("gps_info",): 0},
            "endpoint_last_seen_timestamp_seconds": {("sensor_board",): NOW - 1, ("arm_board",): 0},
            "deadman_active": {("imu_info",): tripped},
            "route_duration_seconds_bucket": {**buckets("imu_info", 0, imu), **buckets("gps_info", 0, 0, 0, 0, gps)},
        },
    )


def seen(tripped: int = 0) -> View:
    return view(snapshot(10, 0, 0), snapshot(12, 100, 10, 3, tripped), NOW)


def test_ages_count_from_the_last_message_and_there_may_be_none() -> None:
    assert [row.age for row in seen().routes] == [5.0, None]
    assert seen().silence == {"sensor_board": 1.0, "arm_board": None}


def test_latencies_are_those_between_the_snapshots() -> None:
    imu, gps = seen().routes
    assert [imu.median, imu.slowest] == pytest.approx([15e-6, 19.9e-6])
    assert [gps.median, gps.slowest] == pytest.approx([150e-6, 199e-6])


def test_a_router_that_was_started_anew_has_no_latency_of_the_one_before() -> None:
    before, after = snapshot(10, 0, 3), snapshot(12, 0, 0)
    anew = {**after.values, "route_duration_seconds_bucket": buckets("gps_info", 0, 0, 2, 2, 4)}
    row = view(before, Snapshot(12, anew), NOW).routes[1]
    assert row.slowest is not None
    assert row.slowest > 0
    shrunk = {**before.values, "route_duration_seconds_bucket": buckets("gps_info", 5, 5, 5, 5, 5)}
    grown = {**after.values, "route_duration_seconds_bucket": buckets("gps_info", 0, 0, 0, 6, 6)}
    assert view(Snapshot(10, shrunk), Snapshot(12, grown), NOW).routes[1].median == pytest.approx(75e-6)


def test_without_new_messages_the_latency_of_all_is_told() -> None:
    still = snapshot(12, 100, 0)
    row = view(still, still, NOW).routes[0]
    assert row.median == pytest.approx(15e-6)


@pytest.mark.parametrize(
    ("order", "first"),
    [
        (Order.TABLE, "imu_info"),
        (Order.RATE, "imu_info"),
        (Order.DROPS, "gps_info"),
        (Order.AGE, "imu_info"),
        (Order.LATENCY, "gps_info"),
    ],
)
def test_the_largest_comes_first_and_what_never_was_last(order: Order, first: str) -> None:
    assert ordered(seen().routes, order)[0].route == first


def test_every_order_has_a_key_of_its_own() -> None:
    assert len({order.key for order in Order} | {"q"}) == len(Order) + 1


def test_a_quantile_is_inside_its_bucket_and_beyond_the_last_bound_unknown() -> None:
    assert quantile({1.0: 10, 2.0: 20, math.inf: 20}, 0.75) == pytest.approx(1.5)
    assert quantile({1.0: 0, math.inf: 1}, 0.5) == math.inf
    assert quantile({1.0: 0, math.inf: 0}, 0.5) is None
    assert quantile({}, 0.5) is None


@pytest.mark.parametrize(
    ("seconds", "text"), [(None, "never"), (0.31, "0.3 s"), (61, "61 s"), (600, "10 min"), (9000, "2 h")]
)
def test_ages_are_told_in_the_unit_that_fits(seconds: float | None, text: str) -> None:
    assert age_text(seconds) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(None, "-"), (35e-6, "35 us"), (1.25e-3, "1.2 ms"), (math.inf, "> 50 ms")]
)
def test_latencies_are_told_in_the_unit_that_fits(seconds: float | None, text: str) -> None:
    assert latency_text(seconds) == text


def printed(shown: object, width: int = 120) -> list[str]:
    console = Console(width=width, color_system=None)
    with console.capture() as capture:
        console.print(shown)
    return [line.rstrip() for line in capture.get().splitlines()]


def test_a_page_has_all_of_it() -> None:
    lines = printed(page(seen(tripped=1), Order.TABLE))
    assert lines[1] == "deadman of imu_info sends  last heard: sensor_board 1.0 s, arm_board never"
    assert lines[3].split() == ["imu_info", "50", "basestation", "50", "5.0", "s", "15", "us", "20", "us", "-"]
    assert lines[4].split()[-2:] == ["3", "stale"]


def test_where_there_are_no_endpoints_nobody_was_heard_last() -> None:
    values = {**snapshot(12, 100, 0).values, "endpoint_last_seen_timestamp_seconds": {}}
    still = Snapshot(12, values)
    assert "last heard" not in "".join(printed(page(view(still, still, NOW), Order.TABLE)))


@pytest.mark.parametrize("height", [6, 7, 24])
def test_a_screen_never_has_more_lines_than_there_are(height: int) -> None:
    lines = printed(screen(seen(), "title", Order.TABLE, height, "no answer"))
    assert len(lines) <= height
    assert lines[0] == "title  no answer"
    assert lines[-1].startswith("sorted by table; keys: t table, r rate")
    assert ("and 2 more" in lines or "and 1 more" in lines) == (height < 7)


# ---- rates ------------------------------------------------------------------------------------------------------

SCRAPE = """\
# HELP router_datagrams_received_total Datagrams taken from the listener's socket.
# TYPE router_datagrams_received_total counter
router_datagrams_received_total{listener="rover"} %(received)d
# TYPE router_datagrams_rejected_total counter
router_datagrams_rejected_total{listener="rover",reason="empty"} 0
router_datagrams_rejected_total{listener="rover",reason="malformed"} 3
# TYPE router_kernel_drops_total counter
router_kernel_drops_total{listener="rover"} 0
# TYPE router_messages_received_total counter
router_messages_received_total{route="imu_info",source="sensor_board"} %(imu)d
router_messages_received_total{route="imu_info",source="spare"} 0
router_messages_received_total{route="gps_info",source="sensor_board"} 0
# TYPE router_datagrams_sent_total counter
router_datagrams_sent_total{route="imu_info",destination="basestation"} %(imu)d
# TYPE router_messages_published_total counter
router_messages_published_total{route="imu_info",topic="imu_data"} 5
# TYPE router_messages_dropped_total counter
router_messages_dropped_total{route="imu_info",target="imu_data",reason="stale"} 2
router_messages_dropped_total{route="imu_info",target="basestation",reason="stale"} 0
# TYPE router_messages_filtered_total counter
router_messages_filtered_total{route="imu_info",target="imu_data"} 4
# TYPE python_info gauge
python_info{version="3.12"} 1
# TYPE router_build_info gauge
router_build_info{version="1.0",table_sha256="abc",protos_sha256="def"} 1
"""


def scraped(at: float, imu: int) -> Snapshot:
    return parse_metrics(SCRAPE % {"received": imu + 3, "imu": imu}, at)


def test_rates_are_per_second_between_two_snapshots() -> None:
    found = view(scraped(10.0, 100), scraped(12.0, 200))
    assert (found.received, found.rate) == (203, 50.0)
    assert [(row.route, row.received, row.rate) for row in found.routes] == [
        ("imu_info", 200, 50.0),
        ("gps_info", 0, 0.0),
    ]


def test_targets_show_what_they_got_lost_and_were_spared() -> None:
    station, topic = view(scraped(0, 0), scraped(1, 7)).routes[0].targets
    assert (station.name, station.is_topic, station.delivered, station.rate) == ("basestation", False, 7, 7.0)
    assert (topic.name, topic.is_topic, topic.delivered, topic.filtered) == ("imu_data", True, 5, 4)
    assert (station.dropped, topic.dropped) == ({}, {"stale": 2})


def test_reasons_that_never_happened_are_left_out() -> None:
    found = view(scraped(0, 0), scraped(1, 0))
    assert (found.rejected, found.routes[0].dropped) == ({"malformed": 3}, {"stale": 2})


def test_a_router_that_was_started_anew_has_no_negative_rate() -> None:
    assert view(scraped(0, 1000), scraped(2, 10)).routes[0].rate == 5.0


def test_a_window_gives_rates_over_its_last_seconds_only() -> None:
    window, rates = Window(seconds=3.0), []
    for at, imu in ((0, 0), (1, 10), (2, 20), (3, 60), (5, 140)):
        window.add(scraped(at, imu))
        rates.append(view(*window.ends).routes[0].rate)
    assert rates == [0.0, 10.0, 10.0, 20.0, 40.0]


def test_a_window_is_of_one_run_of_the_router() -> None:
    window = Window()
    for second in range(10):
        window.add(scraped(second, 10 * second))
    assert [end.at for end in window.ends] == [9 - WINDOW, 9]
    window.add(scraped(10, 5))
    assert [end.at for end in window.ends] == [10, 10]
    window.add(scraped(11, 15))
    assert view(*window.ends).routes[0].rate == 10
    window.clear()
    window.add(scraped(12, 20))
    assert [end.at for end in window.ends] == [12, 12]


def test_a_gateway_is_a_route_to_its_clients_and_to_topics() -> None:
    text = """\
router_messages_received_total{route="dashboard",source="ros"} %d
router_messages_received_total{route="dashboard",source="clients"} 1
router_messages_sent_total{route="dashboard",target="clients"} %d
router_datagrams_sent_total{route="dashboard",destination="websocket"} 3
router_messages_published_total{route="dashboard",topic="/cmd_vel"} 1
router_messages_dropped_total{route="dashboard",target="clients",reason="too_large"} 2
"""
    (row,) = view(parse_metrics(text % (0, 0), 0), parse_metrics(text % (20, 18), 2)).routes
    assert [(each.name, each.is_topic, each.rate) for each in row.targets] == [
        ("/cmd_vel", True, 0.0),
        ("clients", False, 9.0),
    ]
    assert row.lost == {"too_large": 2}


def test_what_the_table_wants_gone_is_not_lost() -> None:
    more = 'router_messages_dropped_total{route="imu_info",target="imu_data",reason="rate_limited"} 9\n'
    text = SCRAPE % {"received": 1, "imu": 1} + more
    (row, _) = view(parse_metrics(text, 0), parse_metrics(text, 1)).routes
    assert (row.dropped, row.lost) == ({"stale": 2, "rate_limited": 9}, {"stale": 2})
    assert row.targets[1].lost == {"stale": 2}


def test_which_table_ran_is_told_with_the_numbers() -> None:
    assert scraped(0, 0).table_sha256 == "abc"
    assert parse_metrics("", 0).table_sha256 == ""


# ---- tables and lines -------------------------------------------------------------------------------------------


def row(route: str, rate: float = 5.0, dropped: dict[str, int] | None = None) -> RouteRow:
    targets = (
        TargetRow("basestation", False, 10, rate, {}, 0),
        TargetRow(f"{route}_topic", True, 10, rate, dropped or {}, 0),
    )
    return RouteRow(route, 10, rate, targets)


def viewed(*rows: RouteRow) -> View:
    return View(rows, received=20, rate=10.0, rejected={"malformed": 2}, kernel_drops=0)


def table_lines(view: View, height: int, width: int = 80) -> list[str]:
    columns = {"seen": lambda row: Text(str(row.received))}
    return printed(route_table(view, Order.DROPS, height, columns), width)


def test_one_line_for_each_route_under_a_header() -> None:
    header, gps, imu = table_lines(viewed(row("imu"), row("gps", dropped={"stale": 3})), height=10)
    assert header.split() == ["route", "in/s", "delivered", "per", "second", "seen", "drops"]
    assert imu.split() == ["imu", "5.0", "basestation", "5.0", "imu_topic", "5.0", "10", "-"]
    assert gps.rstrip().endswith("10  3 stale")


def test_a_low_terminal_shows_troubled_routes_first_and_counts_the_others() -> None:
    shown = table_lines(viewed(row("a"), row("b"), row("c", dropped={"stale": 1}), row("d")), height=4)
    assert len(shown) == 4
    assert shown[1].startswith("c")
    assert shown[3].startswith("and 2 more")


def test_a_line_never_gets_wider_than_the_terminal() -> None:
    assert all(
        len(line) <= 60 for line in table_lines(viewed(row("a" * 20, dropped={"queue_full": 1})), height=9, width=60)
    )


def test_the_summary_adds_everything_up() -> None:
    line = summary_line(viewed(row("imu"), row("gps", dropped={"stale": 3})))
    assert line == "in 20 (10/s), delivered 40 (20/s), lost 3 stale, 2 malformed"


def test_what_the_table_wants_gone_is_told_apart_and_troubles_nobody() -> None:
    line = summary_line(viewed(row("imu", dropped={"stale": 3, "rate_limited": 8})))
    assert line == "in 20 (10/s), delivered 20 (10/s), lost 3 stale, 2 malformed; as the table wants 8 rate_limited"
    shown = table_lines(
        viewed(row("a"), row("b", dropped={"rate_limited": 1}), row("c", dropped={"stale": 1})), height=3
    )
    assert shown[1].startswith("c")


def test_reasons_are_in_order_of_their_number() -> None:
    assert reasons_text({"stale": 1, "queue_full": 3, "loop": 1}) == "3 queue_full, 1 loop, 1 stale"

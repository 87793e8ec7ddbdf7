"""`router top` tells ages and latencies as Prometheus would, in the order that is asked for."""

from __future__ import annotations

import math

import pytest
from rich.console import Console

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS
from router.tools.live import Snapshot
from router.tools.top import Order, Top, quantile, top
from router.tools.top_view import age_text, latency_text, page, screen

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


def seen(order: Order = Order.TABLE, tripped: int = 0) -> Top:
    return top(snapshot(10, 0, 0), snapshot(12, 100, 10, 3, tripped), NOW, order)


def names(shown: Top) -> list[str]:
    return [row.row.route for row in shown.rows]


def test_ages_count_from_the_last_message_and_there_may_be_none() -> None:
    assert [row.age for row in seen().rows] == [5.0, None]
    assert seen().silence == {"sensor_board": 1.0, "arm_board": None}


def test_latencies_are_those_between_the_snapshots() -> None:
    imu, gps = seen().rows
    assert [imu.median, imu.slowest] == pytest.approx([15e-6, 19.9e-6])
    assert [gps.median, gps.slowest] == pytest.approx([150e-6, 199e-6])


def test_a_router_that_was_started_anew_has_no_latency_of_the_one_before() -> None:
    before, after = snapshot(10, 0, 3), snapshot(12, 0, 0)
    anew = {**after.values, "route_duration_seconds_bucket": buckets("gps_info", 0, 0, 2, 2, 4)}
    row = top(before, Snapshot(12, anew), NOW).rows[1]
    assert row.slowest is not None
    assert row.slowest > 0
    shrunk = {**before.values, "route_duration_seconds_bucket": buckets("gps_info", 5, 5, 5, 5, 5)}
    grown = {**after.values, "route_duration_seconds_bucket": buckets("gps_info", 0, 0, 0, 6, 6)}
    assert top(Snapshot(10, shrunk), Snapshot(12, grown), NOW).rows[1].median == pytest.approx(75e-6)


def test_without_new_messages_the_latency_of_all_is_told() -> None:
    still = snapshot(12, 100, 0)
    row = top(still, still, NOW).rows[0]
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
    assert names(seen(order))[0] == first


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


def printed(shown: object) -> list[str]:
    console = Console(width=120, color_system=None)
    with console.capture() as capture:
        console.print(shown)
    return [line.rstrip() for line in capture.get().splitlines()]


def test_a_page_has_all_of_it() -> None:
    lines = printed(page(seen(tripped=1)))
    assert lines[1] == "deadman of imu_info sends  last heard: sensor_board 1.0 s, arm_board never"
    assert lines[3].split() == ["imu_info", "50", "basestation", "50", "5.0", "s", "15", "us", "20", "us", "-"]
    assert lines[4].split()[-2:] == ["3", "stale"]


def test_where_there_are_no_endpoints_nobody_was_heard_last() -> None:
    values = {**snapshot(12, 100, 0).values, "endpoint_last_seen_timestamp_seconds": {}}
    still = Snapshot(12, values)
    assert "last heard" not in "".join(printed(page(top(still, still, NOW))))


@pytest.mark.parametrize("height", [6, 7, 24])
def test_a_screen_never_has_more_lines_than_there_are(height: int) -> None:
    lines = printed(screen(seen(), "title", Order.TABLE, height, "no answer"))
    assert len(lines) <= height
    assert lines[0] == "title  no answer"
    assert lines[-1].startswith("sorted by table; keys: t table, r rate")
    assert ("and 2 more" in lines or "and 1 more" in lines) == (height < 7)

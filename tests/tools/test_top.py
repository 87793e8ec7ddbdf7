"""`router top` tells ages and latencies as Prometheus would, in the order that is asked for."""

from __future__ import annotations

import math
import os
import pty
import re
import sys
from dataclasses import replace

import pytest
from rich.console import Console

from router.compiler.metrics import LATENCY_BOUNDS_NS
from router.observe.problems import Kind, Problem
from router.observe.services import ServiceReading
from router.observe.snapshot import Counts, Snapshot, parse_metrics, quantile
from router.observe.states import StateReading
from router.tools.top import WINDOW, Order, RouteRow, TargetRow, View, Window, ordered, view
from router.tools.top_view import Page, Screen, keys, latency_text, reasons_text, targets_text
from router.values.printing import age_text

BOUNDS = (*(f"{bound / 1e9:g}" for bound in LATENCY_BOUNDS_NS), "+Inf")
PATIENCE = 30.0
TITLE = "rover.yaml at http://127.0.0.1:9108"


def buckets(route: str, *counts: int) -> Counts:
    """Cumulative; the last count holds for all further bounds."""
    padded = [*counts, *[counts[-1]] * (len(BOUNDS) - len(counts))]
    return {(route, bound): float(count) for bound, count in zip(BOUNDS, padded, strict=True)}


def snapshot(at: float, imu: int, gps: int = 0, **more: Counts) -> Snapshot:
    values: dict[str, Counts] = {
        "datagrams_received": {("rover",): imu + gps + 3},
        "datagrams_rejected": {("rover", "malformed"): 3, ("rover", "empty"): 0},
        "messages_received": {
            ("imu_info", "sensor_board"): imu,
            ("imu_info", "spare"): 0,
            ("gps_info", "sensor_board"): gps,
        },
        "datagrams_sent": {("imu_info", "basestation"): imu, ("gps_info", "basestation"): gps},
        "messages_published": {("imu_info", "imu_data"): 5},
        "messages_filtered": {("imu_info", "imu_data"): 4},
        "messages_dropped": {("imu_info", "imu_data", "stale"): 0, ("gps_info", "basestation", "stale"): 3},
        "route_silence_seconds": {("imu_info",): 5},
        "endpoint_silence_seconds": {("sensor_board",): 1},
        "endpoint_unheard_seconds": {("arm_board",): 12},
        "route_duration_seconds_bucket": {**buckets("imu_info", 0, imu), **buckets("gps_info", 0, 0, 0, 0, gps)},
    }
    return Snapshot(at, values | more)


SILENT = Problem(Kind.ENDPOINT_SILENT, {"endpoint": "sensor_board"}, ": last heard 1 s ago")
HELD = Problem(Kind.DEADMAN_ACTIVE, {"route": "imu_info"}, routes=("imu_info",))
SEEN = view(snapshot(10, 0, 0), snapshot(12, 100, 10), [SILENT, HELD])


def lines_of(shown: object, width: int = 120) -> list[str]:
    console = Console(width=width, color_system=None)
    with console.capture() as capture:
        console.print(shown)
    return [line.rstrip() for line in capture.get().splitlines()]


def printed(shown: object, width: int = 120) -> list[str]:
    return [" ".join(line.split()) for line in lines_of(shown, width)]


def test_a_page_has_all_of_it() -> None:
    assert printed(Page(SEEN, TITLE, Order.TABLE)) == [
        TITLE,
        "in 113 (55/s), delivered 115 (55/s), lost 3 malformed, 3 stale",
        "! sensor_board is silent: last heard 1 s ago",
        f"! {HELD.words}",
        "last heard !sensor_board 1.0 s arm_board never",
        "route in/s endpoints topics p50 p99 age drops",
        "!imu_info 50 basestation 50 imu_data 0 15 us 20 us 5.0 s -",
        "gps_info 5.0 basestation 5.0 150 us 199 us never 3 stale",
    ]
    well = replace(SEEN, silence={}, silent=(), problems=(), kernel_drops=7)
    assert printed(Page(well, TITLE, Order.TABLE))[1:3] == [
        "in 113 (55/s), delivered 115 (55/s), lost 7 kernel_drops, 3 malformed, 3 stale",
        "route in/s endpoints topics p50 p99 age drops",
    ]


def test_a_route_that_is_halted_because_nobody_drives_is_no_alarm() -> None:
    halted = Problem(Kind.HALTED, {"route": "imu_info"}, " for 27 min", routes=("imu_info",))
    seen = view(snapshot(10, 0, 0), snapshot(12, 100, 10), [halted])
    assert (seen.problems, seen.calm) == ((), ("imu_info is halted: no commands for 27 min",))
    assert printed(Page(seen, TITLE, Order.TABLE))[2] == "□ imu_info is halted: no commands for 27 min"
    assert not any(line.startswith("!") for line in printed(Page(seen, TITLE, Order.TABLE)))


def test_problems_are_below_each_other_and_wrapped() -> None:
    problems = tuple(f"{name} is silent: last heard 12 s ago, by another address" for name in ("a" * 40, "b", "c", "d"))
    seen = replace(SEEN, problems=problems, silence={})
    assert lines_of(Screen(seen, "t", Order.TABLE, 30), 80)[2:7] == [
        f"! {'a' * 40} is silent: last heard 12 s ago, by",
        "  another address",
        "! b is silent: last heard 12 s ago, by another address",
        "! c is silent: last heard 12 s ago, by another address",
        "! d is silent: last heard 12 s ago, by another address",
    ]
    assert "! and 3 more: see `router doctor`" in lines_of(Screen(seen, "t", Order.TABLE, 12), 80)
    assert len([line for line in lines_of(Page(seen, TITLE, Order.TABLE), 80) if line.startswith("! ")]) == 4


def test_what_is_calm_has_a_line_each_too_after_the_problems() -> None:
    calm = tuple(
        f"{name} is halted: no commands for 27 min, and basestation is silent" for name in ("a" * 40, "b", "c")
    )
    seen = replace(SEEN, problems=("d is silent",), calm=calm, silence={})
    assert lines_of(Screen(seen, "t", Order.TABLE, 30), 80)[2:7] == [
        "! d is silent",
        f"□ {'a' * 40} is halted: no commands for 27 min,",
        "  and basestation is silent",
        "□ b is halted: no commands for 27 min, and basestation is silent",
        "□ c is halted: no commands for 27 min, and basestation is silent",
    ]
    assert "□ and 3 more: see `router doctor`" in lines_of(Screen(seen, "t", Order.TABLE, 10), 80)


def test_a_deadman_that_sends_for_want_of_commands_says_so_in_place_of_drops() -> None:
    (row, *others) = SEEN.routes
    halted = replace(SEEN, routes=(replace(row, rate=0.0, is_tripped=True), *others))
    assert printed(Page(halted, TITLE, Order.TABLE))[6].endswith("none accepted")


@pytest.mark.parametrize("height", [7, 8, 24])
def test_a_screen_never_has_more_lines_than_there_are(height: int) -> None:
    lines = printed(Screen(SEEN, "title", Order.TABLE, height, "no answer"), width=64)
    assert len(lines) <= height
    assert max(map(len, lines)) <= 64
    assert lines[0] == "title no answer"
    assert "sort: [t table] r rate" in lines[-1]
    assert lines[-1].startswith("1-1 of 2") == (height < 8)


def route(name: str, endpoints: int, topics: int, **more: object) -> RouteRow:
    targets = [TargetRow(f"operators_basestation_{index}", False, 9, 1.5, {}, 0) for index in range(endpoints)]
    targets += [TargetRow(f"sensor_board/{name}/raw_{index}", True, 9, 120.0, {}, 0) for index in range(topics)]
    return replace(RouteRow(name, 9, 123.4, tuple(targets), 5.0, 15e-6, 20e-6), **more)  # type: ignore[arg-type]


FULL = View(
    tuple(route(f"measurement_{index}_of_a_very_long_name", index % 4, index % 5) for index in range(40)),
    received=10**9,
    rate=1234.5,
    rejected={"source_mismatch": 123456, "rate_limited": 98765, "malformed": 3},
    kernel_drops=1,
    silence={f"board_number_{index}": 1.5 * index or None for index in range(9)},
    silent=("board_number_8",),
)


@pytest.mark.parametrize(("width", "height"), [(60, 20), (80, 24), (100, 30), (160, 40)])
def test_nothing_is_wrapped_and_every_route_shows_its_destinations(width: int, height: int) -> None:
    lines = lines_of(Screen(FULL, TITLE, Order.TABLE, height), width)
    assert len(lines) == height
    assert max(map(len, lines)) <= width
    first = next(index for index, line in enumerate(lines) if line.startswith("route "))
    for row, line in zip(FULL.routes, lines[first + 1 : -1], strict=False):
        assert not row.targets or "1.5" in line or "120" in line, line


@pytest.mark.parametrize("width", [80, 100, 160])
def test_when_endpoints_were_last_heard_is_never_cut(width: int) -> None:
    shown = " ".join(printed(Screen(FULL, "title", Order.TABLE, 24), width))
    assert all(f"board_number_{index} {age_text(age)}" in shown for index, age in enumerate(FULL.silence.values()))


def test_each_state_has_its_value_and_what_set_it() -> None:
    states = (
        StateReading("mode", "MODE_AUTO", "basestation", 0.4, is_valid=True),
        StateReading("tool", "0", "ann", 70.0, is_valid=False),
        StateReading("is_armed", "false", None, None, is_valid=False),
    )
    lines = printed(Screen(replace(FULL, states=states), "title", Order.TABLE, 24), 60)
    first = next(index for index, line in enumerate(lines) if line.startswith("state "))
    assert lines[first : first + 3] == [
        "state mode MODE_AUTO, set 0.4 s ago by basestation",
        "tool 0, last set 70 s ago by ann",
        "is_armed false, never set",
    ]
    assert "and 2 more" in printed(Screen(replace(FULL, states=states), "title", Order.TABLE, 12), 60)[first + 1]


def test_each_service_has_its_calls() -> None:
    arm = ServiceReading("arm", 1, {"answered": 3}, 0.012, 0.02)
    lines = printed(Screen(replace(FULL, services=(arm,)), "title", Order.TABLE, 24), 80)
    assert "service arm: 1 open, 3 answered, median 12 ms, at most 20 ms" in [line.rstrip() for line in lines]


def test_endpoints_without_room_are_counted() -> None:
    lines = printed(Screen(FULL, "title", Order.TABLE, 12), 60)
    heard = [line for line in lines if "board_number_0" in line or " more" in line]
    assert heard == ["last heard board_number_0 never board_number_1 1.5 s", "board_number_2 3.0 s and 6 more"]


def test_targets_are_shortened_in_their_middle_and_then_counted() -> None:
    targets = route("imu", 0, 3).targets
    assert targets_text(targets, 1000).plain == "  ".join(f"sensor_board/imu/raw_{index} 120" for index in range(3))
    assert targets_text(targets, 50).plain == "senso…raw_0 120  senso…raw_1 120  senso…raw_2 120"
    assert targets_text(targets, 42).plain == "sensor_…/raw_0 120  sensor_…/raw_1 120  +1"
    assert targets_text(targets, 10).plain == "se…0 120 …"
    assert targets_text((), 16).plain == ""


def test_a_target_that_loses_messages_is_shown_first() -> None:
    row = route("imu_info", 2, 3)
    *others, last = row.targets
    losing = replace(last, is_losing=True, dropped={"rate_limited": 500, "queue_full": 12})
    seen = replace(FULL, routes=(replace(row, targets=(*others, losing)),))
    lines = printed(Screen(seen, "title", Order.TABLE, 24), 80)
    line = next(line for line in lines if line.startswith("imu_info"))
    assert re.search(r"!sen\S+2 120 \+2 ", line), line
    assert "!12 queue_full" in line


def test_latencies_are_left_out_where_there_is_no_room() -> None:
    heads = []
    for width in (80, 160):
        lines = printed(Screen(FULL, "title", Order.TABLE, 24), width)
        heads.append(next(line for line in lines if line.startswith("route ")))
    assert heads == ["route in/s endpoints topics age drops", "route in/s endpoints topics p50 p99 age drops"]


def test_keys_scroll_through_the_routes() -> None:
    def shown(first: int, key: str) -> tuple[int, int]:
        screen = Screen(FULL, "title", Order.TABLE, 24, first=first)
        moved = replace(screen, first=screen.moved(key, 80)).table(80).shown
        return moved.start, moved.stop

    page = len(Screen(FULL, "title", Order.TABLE, 24).table(80).shown)
    assert shown(0, "down") == (1, page + 1)
    assert shown(1, "up") == (0, page)
    assert shown(0, "up") == (0, page)
    assert shown(0, "page down") == (page, 2 * page)
    assert shown(0, "end") == (40 - page, 40)
    assert shown(100, "up") == (39 - page, 39)
    assert shown(20, "home") == (0, page)


def test_keys_that_come_together_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    with os.fdopen(ours, "wb", 0) as person, os.fdopen(theirs, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with keys() as wait:
            person.write(b"\x1b[B\x1bOBt\x1b[6~\x1b[Z\x1b[Fq")
            assert [wait(PATIENCE) for _ in range(7)] == ["down", "down", "t", "page down", "", "end", "q"]


def test_what_is_lost_now_is_told_from_what_was_lost_before() -> None:
    assert not SEEN.routes[1].is_losing
    more: Counts = {("gps_info", "basestation", "stale"): 4.0}
    lost = Problem(Kind.MESSAGES_DROPPED, {"target": "basestation", "reason": "stale"}, routes=("gps_info",))
    (other, losing) = view(snapshot(10, 0), snapshot(12, 100, messages_dropped=more), [lost]).routes
    assert not other.is_losing
    assert losing.is_losing
    seen = replace(SEEN, routes=(losing,))
    assert printed(Page(seen, TITLE, Order.TABLE))[-1] == "gps_info 0 !basestation 0 - - never !4 stale"


def test_targets_show_what_they_got_lost_and_were_spared() -> None:
    station, topic = SEEN.routes[0].targets
    assert (station.name, station.is_topic, station.delivered, station.rate) == ("basestation", False, 100, 50.0)
    assert (topic.name, topic.is_topic, topic.delivered, topic.filtered) == ("imu_data", True, 5, 4)
    assert (SEEN.rejected, topic.dropped, SEEN.routes[1].dropped) == ({"malformed": 3}, {}, {"stale": 3})


def test_the_largest_comes_first_and_what_never_was_last() -> None:
    assert {order.value: ordered(SEEN.routes, order)[0].route for order in Order} == {
        "table": "imu_info",
        "rate": "imu_info",
        "drops": "gps_info",
        "age": "imu_info",
        "latency": "gps_info",
    }
    assert len({order.key for order in Order} | {"q"}) == len(Order) + 1


def test_a_router_that_was_started_anew_has_neither_negative_rates_nor_latencies_of_the_one_before() -> None:
    assert view(snapshot(0, 1000), snapshot(2, 10)).routes[0].rate == 5.0
    after = snapshot(12, 0, route_duration_seconds_bucket=buckets("gps_info", 0, 0, 2, 2, 4))
    slowest = view(snapshot(10, 0, 3), after).routes[1].slowest
    assert slowest is not None
    assert slowest > 0
    shrunk = snapshot(10, 0, route_duration_seconds_bucket=buckets("gps_info", 5, 5, 5, 5, 5))
    grown = snapshot(12, 0, route_duration_seconds_bucket=buckets("gps_info", 0, 0, 0, 6, 6))
    assert view(shrunk, grown).routes[1].median == pytest.approx(75e-6)


def test_without_new_messages_the_latency_of_all_is_told() -> None:
    still = snapshot(12, 100)
    assert view(still, still).routes[0].median == pytest.approx(15e-6)


def test_a_quantile_is_inside_its_bucket_and_beyond_the_last_bound_unknown() -> None:
    assert quantile({1.0: 10, 2.0: 20, math.inf: 20}, 0.75) == pytest.approx(1.5)
    assert quantile({1.0: 0, math.inf: 1}, 0.5) == math.inf
    assert quantile({1.0: 0, math.inf: 0}, 0.5) is None
    assert quantile({}, 0.5) is None


def test_times_are_told_in_the_unit_that_fits() -> None:
    ages = [age_text(seconds) for seconds in (None, 0.31, 61, 600, 9000)]
    assert ages == ["never", "0.3 s", "61 s", "10 min", "2 h"]
    latencies = [latency_text(seconds) for seconds in (None, 35e-6, 1.25e-3, math.inf)]
    assert latencies == ["-", "35 us", "1.2 ms", "> 50 ms"]


def test_reasons_are_in_order_of_their_number() -> None:
    assert reasons_text({"stale": 1, "queue_full": 3, "loop": 1}) == "3 queue_full, 1 loop, 1 stale"


def test_a_window_gives_rates_over_its_last_seconds_only() -> None:
    window, rates = Window(), []
    for at, imu in ((0, 0), (1, 10), (2, 20), (3, 60), (5, 140)):
        window.add(snapshot(at, imu))
        rates.append(view(*window.ends).routes[0].rate)
    assert rates == [0.0, 10.0, 10.0, 20.0, 32.5]


def test_a_window_is_of_one_run_of_the_router() -> None:
    window = Window()
    for second in range(10):
        window.add(snapshot(second, 10 * second))
    assert [end.at for end in window.ends] == [9 - WINDOW, 9]
    window.add(snapshot(10, 5))
    assert [end.at for end in window.ends] == [10, 10]
    window.add(snapshot(11, 15))
    assert view(*window.ends).routes[0].rate == 10
    window.clear()
    window.add(snapshot(12, 20))
    assert [end.at for end in window.ends] == [12, 12]


def test_a_gateway_is_a_route_to_its_clients_and_to_topics() -> None:
    text = """\
# TYPE router_messages_received_total counter
router_messages_received_total{route="dashboard",source="ros"} %d
router_messages_received_total{route="dashboard",source="clients"} 1
router_messages_sent_total{route="dashboard",target="clients"} %d
router_datagrams_sent_total{route="dashboard",destination="websocket"} 3
router_messages_published_total{route="dashboard",topic="/cmd_vel"} 1
router_messages_dropped_total{route="dashboard",target="clients",reason="too_large"} 2
# TYPE python_info gauge
python_info{version="3.12"} 1
router_build_info{version="1.0",table_sha256="abc",protos_sha256="def"} 1
"""
    before, after = parse_metrics(text % (0, 0), 0), parse_metrics(text % (20, 18), 2)
    (row,) = view(before, after).routes
    assert [(each.name, each.is_topic, each.rate) for each in row.targets] == [
        ("/cmd_vel", True, 0.0),
        ("clients", False, 9.0),
    ]
    assert row.lost == {"too_large": 2}


def test_what_the_table_wants_gone_is_not_lost() -> None:
    dropped: Counts = {("imu_info", "imu_data", "rate_limited"): 8.0, ("imu_info", "imu_data", "stale"): 2.0}
    seen = view(snapshot(0, 1), snapshot(1, 1, messages_dropped=dropped))
    row = seen.routes[0]
    assert (row.dropped, row.lost, row.targets[1].lost) == ({"stale": 2, "rate_limited": 8}, {"stale": 2}, {"stale": 2})
    assert printed(Page(seen, TITLE, Order.TABLE))[1] == (
        "in 4 (0/s), delivered 6 (0/s), lost 3 malformed, 2 stale; as the table wants 8 rate_limited"
    )

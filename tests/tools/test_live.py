from __future__ import annotations

from router.tools.live import Snapshot, parse_metrics, view
from router.tools.live_window import WINDOW, Window

METRICS = """\
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


def snapshot(at: float, imu: int) -> Snapshot:
    return parse_metrics(METRICS % {"received": imu + 3, "imu": imu}, at)


def test_rates_are_per_second_between_two_snapshots() -> None:
    seen = view(snapshot(10.0, 100), snapshot(12.0, 200))
    assert (seen.received, seen.rate) == (203, 50.0)
    assert [(row.route, row.received, row.rate) for row in seen.routes] == [
        ("imu_info", 200, 50.0),
        ("gps_info", 0, 0.0),
    ]


def test_targets_show_what_they_got_lost_and_were_spared() -> None:
    station, topic = view(snapshot(0, 0), snapshot(1, 7)).routes[0].targets
    assert (station.name, station.is_topic, station.delivered, station.rate) == ("basestation", False, 7, 7.0)
    assert (topic.name, topic.is_topic, topic.delivered, topic.filtered) == ("imu_data", True, 5, 4)
    assert (station.dropped, topic.dropped) == ({}, {"stale": 2})


def test_reasons_that_never_happened_are_left_out() -> None:
    seen = view(snapshot(0, 0), snapshot(1, 0))
    assert (seen.rejected, seen.routes[0].dropped) == ({"malformed": 3}, {"stale": 2})


def test_a_router_that_was_started_anew_has_no_negative_rate() -> None:
    assert view(snapshot(0, 1000), snapshot(2, 10)).routes[0].rate == 5.0


def test_a_window_gives_rates_over_its_last_seconds_only() -> None:
    window, rates = Window(seconds=3.0), []
    for at, imu in ((0, 0), (1, 10), (2, 20), (3, 60), (5, 140)):
        window.add(snapshot(at, imu))
        rates.append(view(*window.ends).routes[0].rate)
    assert rates == [0.0, 10.0, 10.0, 20.0, 40.0]


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
    text = METRICS % {"received": 1, "imu": 1} + more
    (row, _) = view(parse_metrics(text, 0), parse_metrics(text, 1)).routes
    assert (row.dropped, row.lost) == ({"stale": 2, "rate_limited": 9}, {"stale": 2})
    assert row.targets[1].lost == {"stale": 2}


def test_which_table_ran_is_told_with_the_numbers() -> None:
    assert snapshot(0, 0).table_sha256 == "abc"
    assert parse_metrics("", 0).table_sha256 == ""

"""What /diagnostics says: on a router that only counts, with clocks that a test sets; its bytes as rclpy reads them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.metrics_core import Metric as Family
from rclpy.serialization import deserialize_message

from router.compiler import check_table
from router.compiler.program import Program
from router.observe import diagnostics
from router.observe.diagnostics import SNAPSHOTS, Diagnostics, Level, Status, Watch, diagnostic_array
from router.observe.metrics import Asked, CountersCollector
from router.observe.running import Running
from router.ros.types import installed_class
from tests.tables import ROUTES

DiagnosticArray = installed_class("diagnostic_msgs/msg/DiagnosticArray")
DiagnosticStatus = installed_class("diagnostic_msgs/msg/DiagnosticStatus")

SECOND = 10**9
WALL = 1_800_000_000 * SECOND

TABLE = """\
version: 1
extends: {routes}/rover.yaml
endpoints:
  sensor_board: {{stale_after: 3s}}
  arm_board: {{stale_after: never}}
gateways:
  dashboard:
    inbound:
      - topic: /cmd_vel
        type: geometry_msgs/msg/Twist
        deadman: {{timeout: 500ms, send: {{}}}}
"""


@dataclass
class Counting:
    """A router in so far as it counts."""

    program: Program
    counts: list[int]
    kernel_drops: int = 0
    is_waiting: bool = False
    stalled: dict[str, float] = field(default_factory=lambda: {"imu_data": 0.0})
    now: int = 0
    shift: int = 0
    watch: Watch = field(init=False)

    def __post_init__(self) -> None:
        asked: dict[str, Asked] = {
            "kernel_drops": lambda: [(["rover"], self.kernel_drops)],
            "listener_waiting": lambda: [(["rover"], self.is_waiting)],
            "publish_stalled_seconds": lambda: [((topic,), each) for topic, each in self.stalled.items()],
        }
        self._collector = CountersCollector(self.program.counters, lambda: [self.counts], asked, {})
        self.watch = Watch(cast("Running", self))
        self.add(1, "config_last_reload_successful")

    def collect(self) -> Iterator[Family]:
        return self._collector.collect()

    def add(self, times: int, metric: str, *labels: str) -> None:
        self.counts[self.program.counters.index(metric, *labels)] += times

    def set_to(self, value: int, metric: str, *labels: str) -> None:
        self.counts[self.program.counters.index(metric, *labels)] = value

    @property
    def wall(self) -> int:
        return WALL + self.now + self.shift

    def hear(self, endpoint: str) -> None:
        self.set_to(self.wall, "endpoint_last_seen_timestamp_seconds", endpoint)

    def after(self, seconds: float) -> dict[str, Status]:
        self.now += int(seconds * SECOND)
        return {status.name: status for status in self.watch.statuses(self.now, self.wall)}


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Program:
    table = tmp_path_factory.mktemp("diagnostics") / "table.yaml"
    table.write_text(TABLE.format(routes=ROUTES))
    checked = check_table(table)
    assert checked.program is not None, [*map(str, checked.diagnostics)]
    return checked.program


@pytest.fixture
def router(program: Program) -> Counting:
    """It has been looked at once."""
    counting = Counting(program, program.counters.fresh_counts())
    counting.after(0)
    return counting


def test_there_is_a_status_for_the_router_and_each_listener_endpoint_route_and_gateway(router: Counting) -> None:
    table = router.program.table
    reported = router.after(2)
    assert [*reported] == [
        "router",
        "listener/rover",
        *(f"endpoint/{name}" for name in table.endpoints),
        *(f"route/{route.name}" for route in table.routes),
        "gateway/dashboard",
    ]
    assert {status.level for status in reported.values()} == {Level.OK}
    assert reported["endpoint/sensor_board"].hardware_id == "192.168.0.30:8"
    assert reported["route/imu_info"].hardware_id == reported["router"].hardware_id != ""


def test_the_table_is_reported_by_its_name(router: Counting) -> None:
    reported = dict(router.after(1)["router"].values)
    assert (reported["table"], reported["table sha256"]) == ("table.yaml", router.program.table.sha256)


def test_endpoints_and_what_comes_from_them_go_stale_and_come_back(router: Counting) -> None:
    router.hear("sensor_board")
    reported = router.after(3)
    assert reported["endpoint/sensor_board"].level == reported["route/imu_info"].level == Level.OK
    reported = router.after(0.1)
    assert reported["endpoint/sensor_board"].level == reported["route/imu_info"].level == Level.STALE
    assert reported["route/imu_info"].message == "sensor_board is silent for 3.1 s"
    assert reported["route/drive_diag"].level == Level.OK  # another board, with more patience
    router.hear("sensor_board")
    reported = router.after(1)
    assert reported["endpoint/sensor_board"].level == reported["route/imu_info"].level == Level.OK
    assert ("silent for", "1.0 s") in reported["endpoint/sensor_board"].values


def test_who_was_never_heard_is_silent_since_the_start_where_he_is_expected_to_send(router: Counting) -> None:
    silent = router.after(5.1)["endpoint/basestation"]
    assert silent.message == "basestation is silent for 5.1 s, since the router started"
    much_later = router.after(1000)
    for never_stale in ("endpoint/arm_board", "endpoint/container_board", "route/rover_localization"):
        assert much_later[never_stale].level == Level.OK


def test_a_topic_for_which_messages_wait_without_end_is_stuck(router: Counting) -> None:
    router.set_to(3, "messages_waiting", "imu_info", "imu_data")
    assert router.after(1)["route/imu_info"].level == Level.OK  # they may just have come
    for _ in range(SNAPSHOTS):
        router.hear("sensor_board")
        stuck = router.after(1)["route/imu_info"]
    assert (stuck.level, stuck.message) == (Level.WARN, "3 wait for imu_data, which is stuck")
    router.add(1, "messages_published", "imu_info", "imu_data")
    router.hear("sensor_board")
    assert router.after(1)["route/imu_info"].level == Level.OK


def test_a_publisher_that_is_stuck_is_an_error_until_it_goes_on(router: Counting) -> None:
    router.stalled = {"imu_data": 0.9, "imu/mag": 0.9}
    assert router.after(1)["router"].level == Level.OK
    router.stalled = {"imu_data": 61.9, "imu/mag": 0.0}
    told = router.after(1)["router"]
    assert (told.level, told.message) == (
        Level.ERROR,
        "publishing on imu_data is stuck in the ROS middleware, for 61.9 s",
    )
    router.stalled = {"imu_data": 0.0, "imu/mag": 0.0}
    levels = [router.after(1)["router"].level for _ in range(SNAPSHOTS)]
    assert (levels[0], levels[-1]) == (Level.ERROR, Level.OK)


def test_a_publisher_that_takes_long_for_each_message_is_stuck_as_well(router: Counting) -> None:
    for seconds in (0.8, 0.1, 0.6):
        router.stalled = {"imu_data": seconds}
        message = router.after(1)["router"].message
    assert message == "publishing on imu_data is stuck in the ROS middleware, for 1.5 s"


@pytest.mark.parametrize("shift", [-3600 * SECOND, 3600 * SECOND])
def test_a_clock_that_jumps_makes_nobody_silent_and_nobody_heard(router: Counting, shift: int) -> None:
    router.hear("sensor_board")
    router.after(1)
    router.shift = shift
    assert router.after(1)["endpoint/sensor_board"].level == Level.OK
    assert router.after(1.5)["endpoint/sensor_board"].level == Level.STALE
    router.hear("sensor_board")
    assert ("silent for", "1.0 s") in router.after(1)["endpoint/sensor_board"].values


def test_drops_are_told_with_their_reasons_for_as_long_as_anybody_may_need_to_look(router: Counting) -> None:
    router.add(7, "messages_dropped", "imu_info", "imu/mag", "mapping_error")
    for _ in range(SNAPSHOTS - 1):
        reported = router.after(1)["route/imu_info"]
        assert (reported.level, reported.message) == (Level.WARN, "dropped 7 for imu/mag: mapping_error")
        router.hear("sensor_board")
    reported = router.after(1)["route/imu_info"]
    assert reported.level == Level.OK
    assert ("dropped for imu/mag: mapping_error", "7") in reported.values


def test_what_the_network_refuses_is_an_error_of_the_route_and_of_the_endpoint(router: Counting) -> None:
    for route in ("imu_info", "gps_info"):
        router.add(2, "messages_dropped", route, "basestation", "send_error")
    reported = router.after(1)
    assert reported["route/imu_info"].level == reported["route/gps_info"].level == Level.ERROR
    assert reported["endpoint/basestation"].message == "dropped 4 for basestation: send_error"
    assert reported["endpoint/basestation"].level == Level.ERROR
    assert ("dropped: send_error", "4") in reported["endpoint/basestation"].values
    assert reported["endpoint/sensor_board"].level == Level.OK


@pytest.mark.parametrize(
    ("series", "name", "level", "message"),
    [
        ("messages_dropped dashboard /cmd_vel rate_limited", "gateway/dashboard", Level.OK, "serves its clients"),
        ("datagrams_rejected rover ignored", "listener/rover", Level.OK, "receives what arrives"),
        ("datagrams_rejected rover malformed", "listener/rover", Level.WARN, "rejected 9: malformed"),
        ("record_dropped overflow", "router", Level.WARN, "the recording lacks 9: overflow"),
        ("mirror_dropped", "router", Level.WARN, "recordings and taps were not shown 9"),
        (
            "deadman_active dashboard:/cmd_vel",
            "gateway/dashboard",
            Level.ERROR,
            "commands stopped coming: the deadman sends in their place",
        ),
    ],
)
def test_what_is_counted_is_told_where_it_belongs_but_not_what_the_table_asks_for(
    router: Counting, series: str, name: str, level: Level, message: str
) -> None:
    router.add(9, *series.split())
    status = router.after(1)[name]
    assert (status.level, status.message) == (level, message)


def test_a_deadman_that_acts_is_an_error_before_all_else(router: Counting) -> None:
    router.set_to(1, "deadman_active", "manual_drive")
    router.add(3, "deadman_send_errors", "manual_drive", "driving_board")
    reported = router.after(6)
    assert reported["route/manual_drive"].level == Level.ERROR
    assert reported["route/manual_drive"].message == (
        "the deadman could not send 3 to driving_board; "
        "commands stopped coming: the deadman sends in their place; "
        "basestation is silent for 6.0 s, since the router started"
    )
    assert reported["endpoint/driving_board"].level == Level.ERROR
    assert reported["route/manual_arm"].level == Level.STALE


def test_kernel_drops_and_a_failed_reload_are_told(router: Counting) -> None:
    router.kernel_drops = 2
    router.set_to(0, "config_last_reload_successful")
    reported = router.after(1)
    assert reported["listener/rover"].message == "the kernel dropped 2"
    assert reported["router"].message == "the last reload failed, and the table from before it goes on"
    assert reported["listener/rover"].level == reported["router"].level == Level.WARN


def test_a_listener_without_its_network_is_an_error(router: Counting) -> None:
    router.is_waiting = True
    listener = router.after(1)["listener/rover"]
    assert listener.level == Level.ERROR
    assert listener.message == "its address or network interface is not there: nothing comes in"


def test_rates_are_of_the_last_seconds(router: Counting) -> None:
    router.after(3)
    router.add(10, "messages_received", "imu_info", "sensor_board")
    assert ("received per second", "2.0") in router.after(2)["route/imu_info"].values


# ---- bytes ------------------------------------------------------------------------------------------------------

TEXTS = st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=9)
STATUSES = st.builds(
    Status,
    st.sampled_from(Level),
    TEXTS,
    TEXTS,
    TEXTS,
    st.lists(st.tuples(TEXTS, TEXTS), max_size=4).map(tuple),
)


@given(st.integers(0, 2**31 * SECOND - 1), TEXTS, st.lists(STATUSES, max_size=4))
def test_rclpy_reads_the_bytes_as_what_was_told(stamp: int, node: str, reported: list[Status]) -> None:
    data = diagnostic_array(stamp, node, reported)
    message = deserialize_message(data, DiagnosticArray)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(stamp, SECOND)
    assert [
        Status(
            Level(status.level[0]),
            status.name,
            status.message,
            status.hardware_id,
            tuple((value.key, value.value) for value in status.values),
        )
        for status in message.status
    ] == [status._replace(name=f"{node}: {status.name}") for status in reported]


def test_levels_are_those_of_the_message() -> None:
    assert {level.name: bytes([level]) for level in Level} == {
        name: getattr(DiagnosticStatus, name) for name in ("OK", "WARN", "ERROR", "STALE")
    }


# ---- the thread -------------------------------------------------------------------------------------------------


def published(router: Counting, monkeypatch: pytest.MonkeyPatch, publish: Callable[[bytes], None]) -> Diagnostics:
    monkeypatch.setattr(diagnostics, "PERIOD", 0.01)
    return Diagnostics(cast("Running", router), "rover_router", publish)


def test_it_publishes_until_it_is_closed(router: Counting, monkeypatch: pytest.MonkeyPatch) -> None:
    got: list[bytes] = []
    enough = threading.Event()

    def publish(data: bytes) -> None:
        got.append(data)
        if len(got) == 3:
            enough.set()

    thread = published(router, monkeypatch, publish)
    assert enough.wait(10)
    thread.close()
    count = len(got)
    message = deserialize_message(got[0], DiagnosticArray)
    assert message.status[0].name == "rover_router: router"
    assert len(got) == count


def test_what_cannot_be_published_is_told_once_and_tried_again(
    router: Counting, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tries, enough = iter(range(100_000)), threading.Event()

    def publish(data: bytes) -> None:
        if next(tries) == 3:
            enough.set()
        raise RuntimeError("no network")

    thread = published(router, monkeypatch, publish)
    assert enough.wait(10)
    thread.close()
    assert capsys.readouterr().out.count("no network") == 1

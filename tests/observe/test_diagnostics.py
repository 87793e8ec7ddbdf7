"""/diagnostics: what is wrong, at the status that it belongs to; its bytes as rclpy reads them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message

from router.observe import diagnostics
from router.observe.diagnostics import Diagnostics, Level, Report, Status, diagnostic_array
from router.observe.watch import Health
from router.ros.types import installed_class
from tests.observe.counting import SECOND, Counting

DiagnosticArray = installed_class("diagnostic_msgs/msg/DiagnosticArray")
DiagnosticStatus = installed_class("diagnostic_msgs/msg/DiagnosticStatus")


def reported(router: Counting, after: float) -> dict[str, Status]:
    return {status.name: status for status in Report(router.look(after)).statuses()}


def test_there_is_a_status_for_the_router_and_each_listener_endpoint_route_gateway_and_state(router: Counting) -> None:
    table, told = router.program.table, reported(router, 2)
    assert [*told] == [
        "router",
        "listener/rover",
        *(f"endpoint/{name}" for name in table.endpoints),
        *(f"route/{route.name}" for route in table.routes),
        "gateway/dashboard",
        "state/mode",
        "state/driver",
    ]
    assert {status.level for status in told.values()} == {Level.OK}
    assert told["endpoint/sensor_board"].hardware_id == "192.168.0.30:8"
    assert told["route/imu_info"].hardware_id == told["router"].hardware_id != ""


def test_a_state_is_reported_with_its_age_and_who_set_it(router: Counting) -> None:
    status = reported(router, 1)["state/mode"]
    assert status.message == "MODE_MANUAL"
    assert "set by basestation" not in dict(status.values)
    router.count("state", "mode", to=1)
    router.count("state_changes", "mode", to=3)
    router.count("state_set_seconds", "mode", "basestation", to=router.now)
    router.count("messages_dropped", "control_mode", "state.mode", "mapping_error", to=2)
    status = reported(router, 2.5)["state/mode"]
    assert (status.level, status.message) == (Level.OK, "MODE_AUTO")
    assert dict(status.values) == {
        "value": "MODE_AUTO",
        "initial value": "MODE_MANUAL",
        "set by basestation": "2.5 s",
        "dropped: mapping_error": "2",
        "changes": "3",
    }


def test_a_state_that_is_a_text_is_reported_in_quotes(router: Counting) -> None:
    assert reported(router, 1)["state/driver"].message == "''"
    router.texts["driver"] = "left"
    router.count("state_set_seconds", "driver", "driver", to=router.now)
    status = reported(router, 0.5)["state/driver"]
    assert status.message == "'left'"
    values = {"value": "'left'", "initial value": "''", "set by driver": "0.5 s", "changes": "0"}
    assert dict(status.values) == values


def test_the_table_is_reported_by_its_name(router: Counting) -> None:
    told = dict(reported(router, 1)["router"].values)
    assert (told["table"], told["table sha256"]) == ("table.yaml", router.program.table.sha256)


def test_endpoints_and_what_comes_from_them_go_stale_and_come_back(router: Counting) -> None:
    router.hear("sensor_board")
    told = reported(router, 3.1)
    assert told["endpoint/sensor_board"].level == told["route/imu_info"].level == Level.STALE
    assert told["route/imu_info"].message == "sensor_board is silent: last heard 3.1 s ago"
    assert told["route/drive_diag"].level == Level.OK  # another board, with more patience
    router.hear("sensor_board")
    told = reported(router, 1)
    assert told["endpoint/sensor_board"].level == told["route/imu_info"].level == Level.OK
    assert ("silent for", "1.0 s") in told["endpoint/sensor_board"].values


@pytest.mark.parametrize(
    ("series", "name", "level", "message"),
    [
        ("messages_dropped dashboard /cmd_vel rate_limited", "gateway/dashboard", Level.OK, "serves its clients"),
        (
            "datagrams_rejected rover malformed",
            "listener/rover",
            Level.WARN,
            "rover rejects datagrams: malformed, 9 in",
        ),
        (
            "datagrams_rejected dashboard invalid",
            "gateway/dashboard",
            Level.WARN,
            "dashboard rejects datagrams: invalid",
        ),
        ("record_dropped overflow", "router", Level.WARN, "recordings or taps are missing datagrams, 9 in 1 s"),
        (
            "deadman_active dashboard:/cmd_vel",
            "gateway/dashboard",
            Level.WARN,
            "dashboard:/cmd_vel is stopped by",
        ),
        (
            "gateway_topics dashboard not_installed",
            "gateway/dashboard",
            Level.OK,
            "dashboard does not serve topics: not_installed",
        ),
        ("deadman_send_errors manual_drive driving_board", "endpoint/driving_board", Level.ERROR, "the deadman of"),
        (
            "deadman_send_errors manual_drive driving_board",
            "route/manual_drive",
            Level.ERROR,
            "the deadman of manual_drive",
        ),
        ("messages_dropped imu_info basestation stale", "endpoint/basestation", Level.WARN, "messages for basestation"),
        ("messages_dropped imu_info basestation stale", "route/imu_info", Level.WARN, "messages for basestation are"),
    ],
)
def test_a_problem_is_told_where_it_belongs(
    router: Counting, series: str, name: str, level: Level, message: str
) -> None:
    router.count(*series.split(), to=9)
    told = reported(router, 1)
    assert (told[name].level, message in told[name].message) == (level, True), told[name].message
    assert (told["router"].level == Level.OK) == (name != "router")


def test_the_worst_problem_gives_the_level_and_the_message_has_all(router: Counting) -> None:
    router.count("deadman_active", "manual_drive", to=1)
    router.count("deadman_send_errors", "manual_drive", "driving_board", to=3)
    status = reported(router, 6)["route/manual_drive"]
    assert status.level == Level.ERROR
    assert status.message == (
        "the deadman of manual_drive cannot reach driving_board, 3 in 6 s; "
        "manual_drive is stopped by its deadman: no commands get through, and basestation is silent; "
        "basestation has not been heard since the router started"
    )


def test_a_rover_that_nobody_drives_is_well(router: Counting) -> None:
    router.hear("basestation")
    router.look(1)
    router.count("deadman_active", "manual_drive", to=1)
    router.look(1)
    told = reported(router, 61)
    assert told["route/manual_drive"].level == told["endpoint/basestation"].level == Level.OK
    halted = "manual_drive is halted: no commands for 61 s, and basestation is silent"
    assert halted in told["route/manual_drive"].message
    assert told["endpoint/basestation"].message == "is silent: nobody drives"


def test_every_problem_is_told_somewhere(router: Counting) -> None:
    router.is_stuck = True
    for series in ("publish_stalled_seconds imu_data", "kernel_drops rover", "listener_waiting rover"):
        router.count(*series.split(), to=7)
    router.count("config_last_reload_successful", to=0)
    router.count("unhandled", "arm_diag", to=9)
    router.count("messages_waiting", "imu_info", "imu_data", to=30)
    router.count("qos_incompatible", "imu_info", "imu_data", "reliability", to=1)
    health = router.look(6)
    messages = " ".join(status.message for status in Report(health).statuses())
    assert len(health.problems) > 8
    assert [problem.text for problem in health.problems if problem.text not in messages] == []


def test_numbers_are_told_with_their_reasons(router: Counting) -> None:
    for route in ("imu_info", "gps_info"):
        router.count("messages_dropped", route, "basestation", "send_error", to=2)
    told = reported(router, 1)
    assert ("dropped: send_error", "4") in told["endpoint/basestation"].values
    assert ("dropped for basestation: send_error", "2") in told["route/imu_info"].values


def test_rates_are_of_the_last_seconds(router: Counting) -> None:
    router.look(3)
    router.count("messages_received", "imu_info", "sensor_board", to=10)
    assert ("received per second", "2.0") in reported(router, 2)["route/imu_info"].values


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
def test_rclpy_reads_the_bytes_as_what_was_told(stamp: int, node: str, told: list[Status]) -> None:
    data = diagnostic_array(stamp, node, told)
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
    ] == [status._replace(name=f"{node}: {status.name}") for status in told]


def test_levels_are_those_of_the_message() -> None:
    assert {level.name: bytes([level]) for level in Level} == {
        name: getattr(DiagnosticStatus, name) for name in ("OK", "WARN", "ERROR", "STALE")
    }


# ---- the thread -------------------------------------------------------------------------------------------------


class Looked:
    """Health, as far as it is read."""

    def __init__(self, router: Counting) -> None:
        self.look = lambda: router.look(1)


def published(router: Counting, monkeypatch: pytest.MonkeyPatch, publish: Callable[[bytes], None]) -> Diagnostics:
    monkeypatch.setattr(diagnostics, "PERIOD", 0.01)
    return Diagnostics(cast("Health", Looked(router)), "rover_router", publish, lambda: True)


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


def test_nothing_is_published_while_nobody_subscribes(router: Counting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "PERIOD", 0.01)
    turns, got, enough = iter(range(100_000)), list[bytes](), threading.Event()

    def is_wanted() -> bool:
        if next(turns) < 3:
            assert not got
            return False
        enough.set()
        return True

    thread = Diagnostics(cast("Health", Looked(router)), "rover_router", got.append, is_wanted)
    assert enough.wait(10)
    thread.close()
    assert got


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

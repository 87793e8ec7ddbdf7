"""What is wrong with a router, by what it counts; and what is not."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from router.compiler import metrics
from router.compiler.metrics import Mismatch
from router.observe import watch
from router.observe.health import PERIOD, REMEDIES, WINDOW
from router.observe.obedience import Reply
from router.observe.problems import PAGE, Kind, Level, Problem
from router.observe.states import StateReading
from router.observe.watch import Health
from tests.acceptance.site import wait_until
from tests.observe.counting import Counting
from tests.small_tables import HEAD
from tests.small_tables import program as small_program

STALLED = Kind.PUBLISH_STALLED.metric
SENT = "it was sent manual_brake {brake: true}"


def test_a_router_of_which_nothing_is_known_yet_has_no_problem(router: Counting) -> None:
    assert router.told(2) == []


TWIST, DRIVE = "geometry_msgs/msg/Twist", "comms/msg/DrivingBoardMotorMessage"


@pytest.mark.parametrize(
    ("series", "value", "told"),
    [
        (
            "deadman_active manual_drive",
            1,
            "manual_drive is stopped by its deadman: no commands get through",
        ),
        (
            "deadman_active dashboard:/cmd_vel",
            1,
            "dashboard:/cmd_vel is stopped by its deadman: no commands get through",
        ),
        (
            "deadman_send_errors manual_drive driving_board",
            1,
            "the deadman of manual_drive cannot reach driving_board, 1 in 2 s",
        ),
        (
            "deadman_disobeyed manual_drive driving_board",
            1,
            f"driving_board does not obey the brake of manual_drive: {SENT}, and has sent no drive_diag since",
        ),
        ("config_last_reload_successful", 0, "the last reload failed; the old table is still running"),
        (
            "messages_dropped imu_info basestation send_error",
            9,
            "messages for basestation are dropped: send_error, 9 of imu_info in 2 s",
        ),
        (
            "messages_dropped manual_drive driving_board stale",
            9,
            "commands for driving_board are dropped: stale, 9 of manual_drive in 2 s",
        ),
        (
            "messages_dropped dashboard /cmd_vel stale",
            9,
            "commands for /cmd_vel are dropped: stale, 9 of dashboard in 2 s",
        ),
        ("messages_dropped manual_drive driving_board rate_limited", 9, None),
        ("messages_waiting imu_info imu_data", 20, None),
        ("messages_dropped imu_info imu_data rate_limited", 9, None),
        ("datagrams_rejected rover malformed", 9, "rover rejects datagrams: malformed, 9 in 2 s"),
        (
            "superseded_members rover",
            9,
            "rover receives datagrams with several payloads, of which only the last one counts, 9 in 2 s",
        ),
        ("datagrams_rejected rover ignored", 9, None),
        ("datagrams_rejected rover unhandled", 9, None),  # the next one says it
        ("unhandled arm_diag", 9, "arm_diag is received, but no route accepts it, 9 in 2 s"),
        (
            "qos_incompatible imu_info imu_data reliability",
            1,
            "nothing passes between imu_data and peers with another reliability, 1 of them",
        ),
        ("recordings_unsaved disk_full", 2, "the recording of a stop is only in memory: disk_full, 2 of them"),
        ("recordings_lost", 9, "recordings or taps are missing datagrams, 9 in 2 s"),
        ("record_dropped overflow", 9, "recordings or taps are missing datagrams, 9 in 2 s"),
        ("mirror_dropped", 9, "recordings or taps are missing datagrams, 9 in 2 s"),
        ("gateway_topics dashboard served", 9, None),
        (
            "gateway_topics dashboard not_installed",
            2,
            "dashboard does not serve topics: not_installed, 2 of them",
        ),
        ("gateway_topics dashboard several_types", 9, None),
        ("gateway_topics dashboard over_limit", 9, "dashboard does not serve topics: over_limit, 9 of them"),
        ("gateway_topics dashboard refused", 1, "dashboard does not serve topics: refused, 1 of them"),
        (
            "type_incompatible drive_motor drive_motor publisher geometry_msgs/msg/Twist true",
            1,
            f"commands on drive_motor are lost: it has a publisher of {TWIST}; only {DRIVE} is received",
        ),
        (
            "type_incompatible imu_info imu_data subscriber sensor_msgs/msg/Imu false",
            1,
            "imu_data has a subscriber of sensor_msgs/msg/Imu; only comms/msg/ImuSensorInformation is published",
        ),
        ("node_namesakes /rover_router", 1, "another node is called /rover_router, as this router is"),
        ("topic_subscribers imu_data", 9, None),
    ],
)
def test_what_is_counted_is_a_problem_unless_the_table_asks_for_it(
    router: Counting, series: str, value: int, told: str | None
) -> None:
    router.count(*series.split(), to=value)
    problems = router.look(2).problems
    assert [problem.text for problem in problems] == ([told] if told else [])
    assert all(problem.remedy and problem.page == f"{PAGE}#{problem.kind.alert.lower()}" for problem in problems)


def test_a_board_that_does_not_obey_is_told_with_what_it_says(router: Counting) -> None:
    router.count("deadman_disobeyed", "manual_drive", "driving_board", to=1)
    router.given_replies["manual_drive", "driving_board"] = Reply(None, "drive_diag front_left_motor.rpm=300")
    [problem] = router.look(1).problems
    assert problem.kind.level is Level.CRITICAL
    assert problem.text.endswith(f": {SENT}, and says drive_diag front_left_motor.rpm=300")
    assert problem.remedy.startswith("Stop the rover by other means.")
    assert problem.routes == ("manual_drive",)


def test_of_a_deadman_that_sends_the_stopping_times_are_told(router: Counting) -> None:
    router.count("deadman_active", "manual_drive", to=1)
    router.count("deadman_trips", "manual_drive", to=1)
    router.given_replies["manual_drive", "driving_board"] = Reply(0.4321)
    router.given_replies["drive_motor", "driving_board"] = Reply(9.0)
    stopped = "no commands get through; driving_board stopped after 0.43 s"
    assert router.told(1) == [f"manual_drive is stopped by its deadman: {stopped}"]
    assert "manual_drive is halted: no commands for 61 s; driving_board stopped after 0.43 s" in router.told(61)


def test_all_that_another_router_shares_is_one_problem(router: Counting) -> None:
    for shared in ("topic drive_motor", "topic detected_objects", "node /rover_router"):
        router.count("other_routers", "nuc", "4711", *shared.split(), to=1)
    router.count("other_routers", "pi", "12", "node", "/rover_router", to=1)
    one, two = router.look(1).problems
    assert one.text == (
        "another router interferes with this one: process 4711 on nuc; "
        "boards of both get messages on detected_objects and drive_motor twice; both are called /rover_router"
    )
    assert set(one.routes) == {"drive_motor", "detected_object_from_ros_2"}
    assert (two.text, two.kind.level) == (
        "another router interferes with this one: process 12 on pi; both are called /rover_router",
        Level.WARNING,
    )


def test_what_is_asked_for_at_each_look_is_a_problem(router: Counting) -> None:
    router.count("kernel_drops", "rover", to=2)
    router.count("listener_waiting", "rover", to=1)
    router.is_stuck = True
    router.look(0)
    assert router.told(2.5) == [
        "the receive thread is stuck: no progress for 2.5 s",
        "rover receives nothing: its address or network interface does not exist",
        "the kernel drops datagrams of rover, 2 in 2 s",
    ]


def test_a_thread_that_makes_progress_at_times_is_not_stuck(router: Counting) -> None:
    router.is_stuck = True
    assert router.told(1.9) == []
    router.is_stuck = False
    assert router.told(1) == []


def test_a_loss_is_a_problem_for_as_long_as_anybody_may_need_to_look(router: Counting) -> None:
    router.count("messages_dropped", "imu_info", "imu/mag", "mapping_error", to=7)
    for _ in range(int(WINDOW / PERIOD)):
        told = "; ".join(router.told(1))
        assert "messages for imu/mag are dropped: mapping_error, 7 of imu_info in " in told
    assert "mapping_error" not in "; ".join(router.told(1))


def test_who_looks_often_does_not_shorten_the_time(router: Counting) -> None:
    router.count("kernel_drops", "rover", to=9)
    told = [router.told(0.1) for _ in range(100)]
    assert "the kernel drops datagrams of rover, 9 in 10 s" in told[-1]
    assert len(router.look(0.1).snapshots) < 2 * WINDOW / PERIOD
    router.count(STALLED, "imu_data", to=0.6)
    assert not any("stuck" in text for _ in range(5) for text in router.told(0.1))


def test_losses_of_many_routes_are_one_problem_which_names_those_with_most(router: Counting) -> None:
    for count, route in enumerate(("imu_info", "gps_info", "ph_info", "pump_info", "arm_diag"), 1):
        router.count("messages_dropped", route, "basestation", "send_error", to=count)
    [problem] = router.look(1).problems
    assert problem.text.endswith(", 15 of arm_diag, pump_info, ph_info and 2 more routes in 1 s")
    assert set(problem.routes) == {"imu_info", "gps_info", "ph_info", "pump_info", "arm_diag"}


def test_messages_that_wait_at_all_times_are_a_problem(router: Counting) -> None:
    router.count("messages_waiting", "imu_info", "imu_data", to=30)
    assert router.told(1) == []  # they may just have come
    router.count("messages_waiting", "imu_info", "imu_data", to=25)
    for _ in range(int(WINDOW / PERIOD)):
        router.hear("sensor_board")
        told = router.told(1)
    assert "messages wait for a thread that publishes or sends, at least 25" in told


def test_a_publisher_is_stuck_in_one_call_or_in_many_until_it_goes_on(router: Counting) -> None:
    router.count(STALLED, "imu_data", to=0.9)
    router.count(STALLED, "imu/mag", to=0.9)
    assert router.told(1) == []
    router.count(STALLED, "imu_data", to=61.9)
    router.count(STALLED, "imu/mag", to=0.0)
    assert router.told(1) == ["publishing on imu_data is stuck in the ROS middleware for 62 s"]
    router.count(STALLED, "imu_data", to=0.0)
    router.count(STALLED, "imu/mag", to=0.6)
    [_, other] = router.told(1)
    assert other == "publishing on imu/mag is stuck in the ROS middleware for 1.5 s"
    router.count(STALLED, "imu_data", to=0.0)
    router.count(STALLED, "imu/mag", to=0.0)
    told = [[text for text in router.told(1) if "stuck" in text] for _ in range(int(WINDOW / PERIOD) + 1)]
    assert (told[0] != [], told[-1]) == (True, [])


def test_an_endpoint_is_silent_after_its_own_time_and_with_it_the_routes_that_only_it_feeds(router: Counting) -> None:
    router.hear("sensor_board")
    assert router.told(3) == []
    [problem] = router.look(0.1).problems
    assert (problem.text, problem.kind.level) == ("sensor_board is silent: last heard 3.1 s ago", Level.WARNING)
    assert "imu_info" in problem.routes
    assert not {"manual_drive", "ph_info"} & set(problem.routes)  # of the basestation, also of the arm board
    assert "ping 192.168.0.30" in problem.remedy
    router.hear("sensor_board")
    assert router.told(1) == []


def test_who_was_never_heard_may_be_switched_off(router: Counting) -> None:
    found = router.look(5.1).problems
    assert {problem.kind for problem in found} == {Kind.ENDPOINT_NEVER_HEARD}
    assert "basestation has not been heard since the router started" in [problem.text for problem in found]
    silent = {problem.labels["endpoint"] for problem in router.look(1000).problems}
    assert not silent & {"arm_board", "container_board"}  # `never` is stale; is no source


def mismatched(router: Counting, host: str, case: str, listener: str = "rover") -> None:
    router.count("datagrams_rejected", listener, "source_mismatch", to=9)
    router.seen[Mismatch(listener, host, case)] = router.now


def test_a_board_with_another_address_is_named_with_the_one_that_it_should_have(router: Counting) -> None:
    router.look(5)
    mismatched(router, "192.168.0.20", "imu_info")
    mismatched(router, "192.168.0.20", "gps_info")
    found = {problem.labels.get("endpoint", problem.kind.alert): problem for problem in router.look(1).problems}
    told = found["DatagramsRejected"]
    assert told.text == (
        "rover rejects datagrams: source_mismatch, 9 in 6 s: "
        "192.168.0.20 sends messages expected from sensor_board (192.168.0.30)"
    )
    assert told.routes == ("imu_info", "gps_info")
    silent = found["sensor_board"]
    assert silent.text == (
        "sensor_board has not been heard since the router started, while 192.168.0.20 sends its messages"
    )
    assert "If 192.168.0.20 is sensor_board, give it the address 192.168.0.30, or correct `endpoints`" in silent.remedy
    assert "sends its messages" not in found["basestation"].text
    router.count("datagrams_rejected", "rover", "source_mismatch", to=10)
    assert "192.168.0.20" not in "; ".join(router.told(WINDOW))


@pytest.mark.parametrize(
    ("host", "case", "told"),
    [
        (
            "192.168.0.40",
            "imu_info",
            "arm_board (192.168.0.40) sends messages expected from sensor_board (192.168.0.30)",
        ),
        (
            "192.168.0.9",
            "ph_info",
            "192.168.0.9 sends messages expected from arm_board (192.168.0.40) or sensor_board (192.168.0.30)",
        ),
        (
            "192.168.0.30",
            "imu_info",
            "sensor_board (192.168.0.30) uses another port or listener than the table says",
        ),
    ],
)
def test_who_sends_what_another_should_is_named(router: Counting, host: str, case: str, told: str) -> None:
    mismatched(router, host, case)
    [rejected] = [each for each in router.look(1).problems if each.kind is Kind.DATAGRAMS_REJECTED]
    assert rejected.more == f", 9 in 1 s: {told}"


def test_of_many_strangers_a_few_are_named(router: Counting) -> None:
    for number in range(20):
        mismatched(router, f"10.0.0.{number}", "imu_info")
    [rejected] = [each for each in router.look(1).problems if each.kind is Kind.DATAGRAMS_REJECTED]
    assert rejected.more.count("sends messages expected from sensor_board") == 3
    assert rejected.more.endswith("; and 17 more")


def test_tcpdump_takes_no_interface_in_an_address() -> None:
    remedy = Kind.ENDPOINT_SILENT.remedy_at("fe80::1%eth0")
    assert "`ping fe80::1%eth0`, `tcpdump -n udp and host fe80::1`" in remedy


def test_where_all_are_silent_it_is_the_network(router: Counting) -> None:
    assert {problem.remedy.partition(":")[0] for problem in router.look(1000).problems} == {"All endpoints are silent"}


def test_who_is_silent_while_a_deadman_acts_comes_before_others_that_are(router: Counting) -> None:
    router.hear("sensor_board")
    router.hear("basestation")
    router.count("deadman_active", "manual_drive", to=1)
    stopped, *silent, _ = router.told(10)
    assert stopped == "manual_drive is stopped by its deadman: no commands get through, and basestation is silent"
    assert silent == [
        "basestation is silent: last heard 10 s ago",
        "sensor_board is silent: last heard 10 s ago",
    ]


def parked(router: Counting, *routes: str) -> None:
    """Somebody drove, and stopped more than a minute ago; boards still send."""
    router.hear("basestation")
    router.look(1)
    for route in routes:
        router.count("deadman_active", route, to=1)
        router.count("deadman_trips", route, to=1)
    for _ in range(61):
        for board in ("sensor_board", "driving_board"):
            router.hear(board)
        router.look(1)


def test_a_rover_that_nobody_drives_is_halted_and_that_is_no_fault(router: Counting) -> None:
    router.count("deadman_active", "manual_drive", to=1)
    [just_stopped] = router.look(1).problems
    assert (just_stopped.kind, just_stopped.kind.level) == (Kind.DEADMAN_ACTIVE, Level.WARNING)
    parked(router, "manual_drive", "manual_arm")
    router.hear("basestation")
    found = router.look(1).problems
    assert [problem.text for problem in found] == [
        "manual_drive is halted: no commands for 61 s",
        "manual_arm is halted: no commands for 61 s",
    ]
    assert not any(problem.kind.level.is_fault for problem in found)
    router.count("deadman_active", "manual_arm", to=0)
    router.count("deadman_active", "manual_drive", to=0)
    assert router.told(0) == []
    router.count("deadman_active", "manual_drive", to=1)
    router.count("deadman_trips", "manual_drive", to=2)
    assert [problem.kind for problem in router.look(1).problems] == [Kind.DEADMAN_ACTIVE]


def test_a_trip_between_two_looks_begins_anew(router: Counting) -> None:
    parked(router, "manual_drive")
    router.count("deadman_trips", "manual_drive", to=2)  # somebody has driven in between
    assert Kind.DEADMAN_ACTIVE in {problem.kind for problem in router.look(1).problems}


def test_who_drives_may_be_silent_while_nobody_does_and_a_board_may_not(router: Counting) -> None:
    parked(router, "manual_drive")
    [halted] = router.look(1).problems
    assert halted.text == "manual_drive is halted: no commands for 61 s, and basestation is silent"
    [first, *_, last] = router.told(4)
    assert first == "driving_board is silent: last heard 6.0 s ago"
    assert last.startswith("manual_drive is halted")


@pytest.mark.parametrize(
    "failure",
    ["messages_dropped manual_drive driving_board stale", "deadman_send_errors manual_drive driving_board"],
)
def test_commands_that_are_refused_and_a_deadman_that_cannot_send_are_faults_however_long(
    router: Counting, failure: str
) -> None:
    parked(router, "manual_drive")
    router.count(*failure.split(), to=9)
    kinds = {problem.kind for problem in router.look(1).problems}
    assert Kind.DEADMAN_ACTIVE in kinds
    assert Kind.HALTED not in kinds


def lost_for(router: Counting, route: str, endpoint: str, to: int, reason: str = "send_buffer_full") -> None:
    router.count("messages_dropped", route, endpoint, reason, to=to)


def told_of(router: Counting, after: float, kind: Kind) -> Problem:
    [problem] = [each for each in router.look(after).problems if each.kind is kind]
    return problem


def test_losses_towards_an_endpoint_that_is_silent_are_told_with_its_silence_and_its_remedy(router: Counting) -> None:
    router.hear("driving_board")
    router.hear("basestation")
    router.look(3)
    router.hear("basestation")
    router.count("deadman_active", "manual_drive", to=1)
    lost_for(router, "manual_drive", "driving_board", 40)
    lost_for(router, "drive_motor", "driving_board", 2)
    router.count("messages_dropped", "manual_drive", "driving_board", "stale", to=1)  # no consequence of that
    found = router.look(3).problems
    assert [problem.kind for problem in found if problem.kind is not Kind.ENDPOINT_NEVER_HEARD] == [
        Kind.DEADMAN_ACTIVE,
        Kind.ENDPOINT_SILENT,
        Kind.COMMANDS_DROPPED,
    ]
    stopped, silent, dropped = (each for each in found if each.kind is not Kind.ENDPOINT_NEVER_HEARD)
    assert stopped.more == ", and driving_board does not answer"
    answer = "does not answer: 42 of manual_drive, drive_motor for it lost in 6 s"
    assert silent.text == f"driving_board is silent: last heard 6.0 s ago, and {answer}"
    assert stopped.remedy == silent.remedy
    assert silent.remedy.startswith("Check its power, cable or radio, and address: `ping 192.168.0.222`")
    assert dropped.labels["reason"] == "stale"


def test_losses_towards_an_endpoint_that_was_silent_are_told_with_its_return(router: Counting) -> None:
    router.hear("driving_board")
    router.look(1)
    router.count("endpoint_silences", "driving_board", to=1)
    lost_for(router, "manual_drive", "driving_board", 40)
    told = [problem.kind for problem in router.look(1).problems]
    assert Kind.ENDPOINT_RETURNED in told
    assert Kind.COMMANDS_DROPPED not in told
    router.look(20)
    router.hear("driving_board")
    lost_for(router, "manual_drive", "driving_board", 80)
    assert Kind.COMMANDS_DROPPED in [problem.kind for problem in router.look(1).problems]


def test_losses_towards_an_endpoint_that_was_never_heard_have_the_remedy_of_its_silence(router: Counting) -> None:
    router.hear("basestation")
    lost_for(router, "manual_drive", "driving_board", 40)
    dropped = told_of(router, 4.9, Kind.COMMANDS_DROPPED)  # may still come: both causes
    assert dropped.remedy.startswith("driving_board does not answer: check power, cable and address. If it answers, ")
    router.hear("basestation")
    dropped = told_of(router, 1, Kind.COMMANDS_DROPPED)
    assert dropped.text.endswith("in 6 s: driving_board has not been heard since the router started")
    assert dropped.remedy.startswith("Check its power, cable or radio, and address: `ping 192.168.0.222`")


def test_an_operator_who_is_out_of_reach_is_named_for_as_long_as_that_lasts(router: Counting) -> None:
    parked(router, "manual_drive")
    for number in range(10):
        for board in ("sensor_board", "driving_board"):
            router.hear(board)
        lost_for(router, "imu_info", "basestation", 50 * number)
        found = router.look(1).problems
    stopped, silent = found
    assert stopped.text.startswith(
        "manual_drive is stopped by its deadman: no commands get through, and basestation is"
    )
    assert silent.text.startswith("basestation is silent: last heard 7")
    assert ", and does not answer: 450 of imu_info for it lost in 10 s" in silent.text


def test_an_operator_who_comes_back_with_another_address_is_named_after_any_time(router: Counting) -> None:
    parked(router, "manual_drive", "manual_arm")
    for board in ("sensor_board", "driving_board"):
        router.hear(board)
    mismatched(router, "192.168.0.77", "manual_drive")
    found = {problem.kind: problem for problem in router.look(1).problems}
    assert [*found] == [Kind.DEADMAN_ACTIVE, Kind.ENDPOINT_SILENT, Kind.DATAGRAMS_REJECTED, Kind.HALTED]
    assert found[Kind.DEADMAN_ACTIVE].labels == {"route": "manual_drive"}
    assert found[Kind.DEADMAN_ACTIVE].more == ", while 192.168.0.77 sends those of basestation"
    assert found[Kind.ENDPOINT_SILENT].more.endswith("ago, while 192.168.0.77 sends its messages")
    for kind in (Kind.DEADMAN_ACTIVE, Kind.ENDPOINT_SILENT):
        assert found[kind].remedy.startswith("If 192.168.0.77 is basestation, give it the address 192.168.0.10")


def test_commands_that_a_state_withholds_are_told_as_the_cause_of_the_stop(router: Counting) -> None:
    router.count("deadman_active", "drive_motor", to=1)
    router.count("messages_filtered", "drive_motor", "driving_board", to=9)
    [stopped] = router.look(1).problems
    assert stopped.more == ", and 9 for driving_board were withheld, mode is MODE_MANUAL"
    assert stopped.remedy.endswith("`router explain drive_motor` shows it.")
    router.count("deadman_active", "manual_drive", to=1)
    router.count("messages_filtered", "manual_drive", "driving_board", to=2)
    [other] = [each for each in router.look(1).problems if each.labels["route"] == "manual_drive"]
    assert other.more == ", and 2 for driving_board were withheld"


def test_a_state_has_its_value_and_who_set_it_how_long_ago(router: Counting) -> None:
    driver = StateReading("driver", "''", None, None, is_valid=False)
    assert router.look(1).states == (StateReading("mode", "MODE_MANUAL", None, None, is_valid=False), driver)
    router.count("state", "mode", to=1)
    router.count("state_set_seconds", "mode", "basestation", to=router.now)
    router.texts["driver"] = "left"
    set_by = StateReading("mode", "MODE_AUTO", "basestation", 5.0, is_valid=True)
    assert router.look(5).states == (set_by, replace(driver, value="'left'"))
    router.count("state", "mode", to=0)
    [expired, _] = router.look(1).states
    assert (expired.value, expired.origin) == ("MODE_MANUAL", "last set 6.0 s ago by basestation")


def test_commands_that_are_dropped_are_told_as_the_cause_of_the_stop(router: Counting) -> None:
    router.hear("basestation")
    router.count("deadman_active", "manual_drive", to=1)
    router.count("messages_dropped", "manual_drive", "driving_board", "mapping_error", to=9)
    stopped, dropped = router.look(1).problems
    assert stopped.more == ", and 9 for driving_board were dropped: mapping_error"
    assert stopped.remedy == dropped.remedy == REMEDIES["mapping_error"]


@pytest.mark.parametrize(
    ("route", "remedy"), [("manual_drive", "waited in this computer"), ("drive_motor", "clock of")]
)
def test_clocks_of_other_computers_matter_for_messages_of_ros_only(router: Counting, route: str, remedy: str) -> None:
    router.count("messages_dropped", route, "driving_board", "stale", to=9)
    [dropped] = router.look(1).problems
    assert remedy in dropped.remedy
    assert ("clock" in dropped.remedy) is (route == "drive_motor")


def test_a_case_that_is_accepted_from_a_topic_only_is_told_with_who_sent_it(router: Counting) -> None:
    router.count("unhandled", "drive_motor", to=9)
    router.seen[Mismatch("rover", "192.168.0.10", "drive_motor")] = router.now
    [problem] = router.look(1).problems
    assert problem.text == (
        "drive_motor is received, but no route accepts it, 9 in 1 s: it is accepted only from topic drive_motor; "
        "basestation (192.168.0.10) sent it"
    )
    assert problem.remedy.endswith("or write a route for drive_motor with this `source`.")


def test_a_field_that_the_envelope_lacks_is_one_problem_with_number_and_sender(router: Counting) -> None:
    router.count("unhandled", metrics.UNKNOWN_CASE, to=9)
    router.count("datagrams_rejected", "rover", "unknown_case", to=9)
    router.seen[Mismatch("rover", "192.168.0.30", "field 77")] = router.now
    [problem] = router.look(1).problems
    assert problem.text == "rover rejects datagrams: unknown_case, 9 in 1 s: sensor_board (192.168.0.30) sends field 77"


def drive(router: Counting, *numbers: int) -> list[Problem]:
    """Receive these numbers of commands, one number per second; return the bursts after the last second."""
    for number in numbers:
        router.sent += number
        router.count("messages_received", "manual_drive", "basestation", to=router.sent)
        found = router.look(1).problems
    return [problem for problem in found if problem.kind is Kind.COMMAND_BURST]


def test_commands_that_were_stored_while_the_link_was_lost_are_told_once_with_their_number(router: Counting) -> None:
    with capture_logs() as logged:
        assert drive(router, 40, 41, 39, 40, 0, 0, 0, 0) == []
        [burst] = drive(router, 190)
        assert burst.kind.level is Level.INFO
        assert burst.text.endswith("a burst of commands after a silence, 190 in 1.0 s after 4.0 s")
        drive(router, 70, 40, 40)  # a burst may extend over two snapshots
        assert drive(router, 40, 40, 40, 40, 40, 40, 40) == []
    assert [line["event"] for line in logged if "silence" in line["event"]] == [
        "many commands arrived at once after a silence: they may be old"
    ]


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 0, 0, 200),  # how fast this sender usually is, is not known yet
        (40, 40, 40, 40, 0, 0, 0, 40, 2, 0, 0, 60),
        (40, 40, 40, 40, 0, 200),
        (1, 1, 1, 1, 0, 0, 0, 8),
    ],
    ids=["first", "short driving", "no silence", "few"],
)
def test_other_driving_is_no_burst(router: Counting, numbers: tuple[int, ...]) -> None:
    assert drive(router, *numbers) == []


def test_what_explains_other_problems_comes_first(router: Counting) -> None:
    router.hear("basestation")
    router.count("deadman_active", "manual_drive", to=1)
    router.count("deadman_send_errors", "manual_drive", "driving_board", to=3)
    router.count("messages_dropped", "imu_info", "basestation", "stale", to=3)
    kinds = [problem.kind for problem in router.look(6).problems if problem.kind is not Kind.ENDPOINT_NEVER_HEARD]
    assert kinds == [Kind.DEADMAN_CANNOT_SEND, Kind.DEADMAN_ACTIVE, Kind.ENDPOINT_SILENT, Kind.MESSAGES_DROPPED]


def test_a_serial_line_that_is_closed_is_a_problem(tmp_path: Path) -> None:
    line = "  uart: {serial: /dev/ttyAMA0, baud: 9600, framing: cobs}\n"
    head = HEAD.replace("endpoints:\n", f"{line}endpoints:\n  lander: {{listener: uart, kind: board}}\n")
    router = Counting(small_program(tmp_path, "  ph_info: {source: lander, destinations: [basestation]}\n", head))
    [closed] = router.look(2).problems
    assert closed.text == "the link to lander is closed: nothing is received or sent"
    assert "`fuser -v /dev/ttyAMA0`" in closed.remedy
    router.count("link_up", "lander", to=1)
    [silent] = router.look(10).problems
    assert silent.text == "lander has not been heard since the router started"
    assert "the wires of /dev/ttyAMA0" in silent.remedy


def test_remedies_for_a_board_on_a_serial_line_are_about_the_line(tmp_path: Path) -> None:
    line = "  uart: {serial: /dev/ttyAMA0, baud: 9600, framing: cobs}\n"
    head = HEAD.replace("endpoints:\n", f"{line}endpoints:\n  lander: {{listener: uart, kind: board}}\n")
    deadman = "deadman: {timeout: 200ms, send: {manual_brake: {brake: true}}, to: [lander]}"
    route = f"  manual_drive: {{source: basestation, destinations: [lander], {deadman}}}\n"
    router = Counting(small_program(tmp_path, route, head))
    router.look(1)
    router.count("link_up", "lander", to=1)
    router.count("deadman_send_errors", "manual_drive", "lander", to=3)
    router.count("messages_dropped", "manual_drive", "lander", "send_error", to=3)
    router.count("messages_dropped", "manual_drive", "lander", "send_buffer_full", to=3)
    remedies = {each.labels.get("reason", each.kind.name): each.remedy for each in router.look(2).problems}
    assert remedies == {
        "DEADMAN_CANNOT_SEND": (
            "Stop the rover by other means. Check plug and power of lander, and that no other program has its serial "
            "line: `fuser -v /dev/ttyAMA0`."
        ),
        "send_error": (
            "Its serial line is closed: check plug and power, and `fuser -v /dev/ttyAMA0`; the log says why."
        ),
        "send_buffer_full": (
            "Its serial line is full. Does its firmware read? Else raise `baud` on both sides, give lander a "
            "`bandwidth` below it, or route less."
        ),
    }


@pytest.mark.parametrize("kind", Kind, ids=lambda kind: kind.alert)
def test_every_kind_has_words_of_labels_of_its_metric(kind: Kind) -> None:
    if kind.metric:
        assert set(kind.labels) <= set(metrics.metric(kind.metric).labels)
    labels = {label: f"{{{label}}}" for label in kind.labels}
    problem = Problem(kind, labels, " for 2 s", "wait", ("imu_info",))
    assert problem.words == kind.words
    assert Problem.of(json.loads(json.dumps(problem.json()))) == problem


def test_each_reason_to_reject_a_datagram_has_a_remedy() -> None:
    meant = {*metrics.INTENDED_REASONS, "unhandled"}
    assert {*metrics.REJECT_REASONS} - meant <= REMEDIES.keys()


def test_each_loss_that_nobody_intends_has_a_remedy() -> None:
    never = {"loop"}
    assert {*metrics.DROP_REASONS, *metrics.GATEWAY_DROP_REASONS} - metrics.INTENDED_REASONS - never <= REMEDIES.keys()


def test_remedies_are_of_reasons_that_there_are() -> None:
    assert REMEDIES.keys() <= {
        *metrics.DROP_REASONS,
        *metrics.GATEWAY_DROP_REASONS,
        *metrics.REJECT_REASONS,
        *metrics.GATEWAY_REJECT_REASONS,
        *metrics.UNSAVED_REASONS,
        *metrics.TOPIC_STATES.keys() - metrics.SERVED_STATES,
    }


# ---- the thread -----------------------------------------------------------------------------------------------------


def test_it_looks_until_it_is_closed(router: Counting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "PERIOD", 0.01)
    health, looks = Health(router), router.collected
    wait_until(lambda: router.collected > looks + 1, "the second look")
    router.count("kernel_drops", "rover", to=9)
    assert [problem.kind for problem in health.look().problems] == [Kind.KERNEL_DROPS]
    health.close()
    looks = router.collected
    assert not threading.Event().wait(0.05)
    assert router.collected == looks


def test_what_fails_is_logged_once_and_tried_again(
    router: Counting, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(watch, "PERIOD", 0.01)
    health = Health(router)
    tries, enough = iter(range(100_000)), threading.Event()

    def read(*_: object) -> None:
        if next(tries) == 3:
            enough.set()
        raise RuntimeError("no counters")

    monkeypatch.setattr(router, "read", read)
    assert enough.wait(10)
    health.close()
    assert capsys.readouterr().out.count("no counters") == 1


def test_an_endpoint_that_was_silent_and_is_back_leaves_a_trace_for_some_minutes(router: Counting) -> None:
    router.told(0)
    for endpoint in router.program.table.endpoints:
        router.hear(endpoint)
    assert router.told(1) == []
    router.count("endpoint_silences", "arm_board", to=1)
    router.count("endpoint_last_silence_seconds", "arm_board", to=2_340_000_000)
    [told] = router.look(1).problems
    assert told.text == "arm_board was silent and is back: for 2.3 s, until 0.0 s ago"
    assert not told.kind.level.is_fault
    for _ in range(4):
        for endpoint in router.program.table.endpoints:
            router.hear(endpoint)
        [later] = [each for each in router.told(60) if "is back" in each]
    assert later.endswith("for 2.3 s, until 4 min ago")
    assert not [each for each in router.told(70) if "is back" in each]

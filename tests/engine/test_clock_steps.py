"""Commands to boards are as old as they can be after the wall clock was set, everything else is as young."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.carrier.test_from_ros import drive, twist
from tests.engine.rig import BASESTATION, HEAD, Rig, program
from tests.engine.test_both_directions import MS, SECOND, enveloped

HEAD_MORE = HEAD.replace("routes:", "  slow_board: {address: 192.168.0.70:8, kind: board, bandwidth: 10kB/s}\nroutes:")
FROM_UDP = """\
  manual_drive:
    source: basestation
    destinations:
      [driving_board, recorder, slow_board, {endpoint: sensor_board, max_rate: 20 Hz, on_limit: latest}]
    topics: [{topic: drive, type: comms/msg/BasestationManualDrive, fields: auto}]
    ttl: 200ms
    deadman: {none: not part of this test}
"""
FROM_ROS = """\
  drive_motor:
    source: {topic: drive, type: TYPE}
    fields: FIELDS
    destinations: [driving_board, recorder, slow_board]
    ttl: 200ms
    deadman: {none: not part of this test}
"""
BOARDS = ("driving_board", "slow_board", "sensor_board")
COMMAND = enveloped(manual_drive={"turn": 5})
PLAIN = FROM_ROS.replace("TYPE", "comms/msg/DrivingBoardMotorMessage").replace("FIELDS", "auto")
STAMPED = FROM_ROS.replace("TYPE", "geometry_msgs/msg/TwistStamped").replace(
    "FIELDS", "{distance_to_go: float32(twist.linear.x)}"
)


def stall(rig: Rig, by: int) -> None:
    """Like a process that is stopped for 3 s, within which the clock is set."""
    rig.pass_time(SECOND)
    rig.set_clock(by)
    rig.pass_time(2 * SECOND)


def reached(rig: Rig) -> set[str]:
    return {name for name, _ in rig.sent} | {name for name, _ in rig.published}


@pytest.mark.parametrize("by", [-3 * SECOND, 3 * SECOND, -2900 * MS, -3600 * SECOND, 0])
def test_old_commands_reach_no_board_whatever_was_done_to_the_clock(tmp_path: Path, by: int) -> None:
    rig = Rig(program(tmp_path, FROM_UDP, HEAD_MORE))
    rig.receive(COMMAND, BASESTATION)
    rig.pass_time(SECOND)
    assert reached(rig) == {*BOARDS, "recorder", "drive"}
    rig.sent.clear()
    stall(rig, by)
    for age in range(2900 * MS, 300 * MS, -100 * MS):
        rig.arrived_before = age
        rig.receive(COMMAND, BASESTATION)
        rig.pass_time(MS)
    rig.pass_time(SECOND)
    assert not reached(rig) & {*BOARDS}
    assert {rig.dropped("manual_drive", board)["stale"] for board in BOARDS} == {26}


@pytest.mark.parametrize("by", [-3 * SECOND, -2900 * MS])
def test_telemetry_is_taken_for_as_young_as_it_can_be(tmp_path: Path, by: int) -> None:
    rig = Rig(program(tmp_path, FROM_UDP, HEAD_MORE))
    rig.receive(COMMAND, BASESTATION)
    rig.pass_time(5 * SECOND)
    rig.sent.clear()
    rig.published.clear()
    rig.set_clock(by)
    rig.pass_time(10 * MS)
    rig.receive(COMMAND, BASESTATION)
    assert reached(rig) == {"recorder", "drive"}


@pytest.mark.parametrize("routes", [PLAIN, STAMPED])
@pytest.mark.parametrize("by", [-3 * SECOND, 3 * SECOND, 0])
def test_old_messages_of_ros_reach_no_board_either(tmp_path: Path, routes: str, by: int) -> None:
    rig = Rig(program(tmp_path, routes, HEAD_MORE))

    def take() -> None:
        stamp = rig.wall(rig.now - rig.arrived_before)
        rig.take("drive", twist(1, stamp) if routes == STAMPED else drive(1))

    take()
    rig.pass_time(SECOND)
    assert reached(rig) == {"driving_board", "slow_board", "recorder"}
    rig.sent.clear()
    stall(rig, by)
    for age in range(2900 * MS, 300 * MS, -100 * MS):
        rig.arrived_before = age
        take()
        rig.pass_time(MS)
    rig.pass_time(SECOND)
    assert not reached(rig) & {*BOARDS}


def test_a_publisher_that_goes_on_is_obeyed_at_once_after_its_clock_was_set_back(tmp_path: Path) -> None:
    rig = Rig(program(tmp_path, PLAIN, HEAD_MORE))
    for number in range(200):
        if number == 100:
            rig.set_clock(-3 * SECOND)
        rig.take("drive", drive(1), follows=number > 0)
        rig.pass_time(20 * MS)
    assert rig.count("datagrams_sent", "drive_motor", "driving_board") == 200

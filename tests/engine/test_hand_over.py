"""Two sources that take turns at one board: no deadman brakes against the one who drives now, and the last one does."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.program import Program
from tests.engine.rig import BASESTATION, SENSOR_BOARD, Rig, program
from tests.engine.test_both_directions import BRAKE, MS, SECOND, drive, enveloped

ROUTES = """\
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 200ms
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board], HANDS_OVER}
  drive_motor:
    source: {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}
    fields: auto
    destinations: [{endpoint: driving_board, when: distance_to_go < 100}, recorder]
    ttl: 200ms
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board], disarmed_by: [manual_drive]}
  manual_brake:
    - {source: basestation, destinations: [driving_board], deadman: {none: "it is what stops the rover"}}
    - {source: sensor_board, destinations: [recorder]}
"""
BOTH = "disarmed_by: [drive_motor, manual_brake]"
TURN = enveloped(manual_drive={"turn": 5})
FAR = 1000.0
"""Farther than the driving board is sent: such a command goes to the recorder alone."""


@cache
def taking_turns(says: str) -> Program:
    """`says` is the rest of the operator's deadman."""
    with TemporaryDirectory() as folder:
        return program(Path(folder), ROUTES.replace("HANDS_OVER", says))


@pytest.fixture
def rig() -> Rig:
    return Rig(taking_turns(BOTH))


def brakes(rig: Rig) -> int:
    return rig.sent.count(("driving_board", BRAKE))


def operator_drives(rig: Rig, ns: int) -> None:
    for _ in range(ns // (50 * MS)):
        rig.receive(TURN, BASESTATION)
        rig.pass_time(50 * MS)


def software_drives(rig: Rig, ns: int, distance: float = 2.0) -> None:
    for _ in range(ns // (50 * MS)):
        rig.take("drive_motor", drive(distance))
        rig.pass_time(50 * MS)


def test_a_deadman_that_has_tripped_is_released_by_who_takes_over(rig: Rig) -> None:
    operator_drives(rig, SECOND)
    rig.pass_time(2 * SECOND)
    assert rig.count("deadman_active", "manual_drive") == 1
    rig.sent.clear()
    software_drives(rig, 2 * SECOND)

    assert brakes(rig) == 0
    assert rig.changes == [("manual_drive", True), ("manual_drive", False)]
    assert (rig.count("deadman_active", "manual_drive"), rig.count("deadman_trips", "manual_drive")) == (0, 1)
    operator_drives(rig, 50 * MS)
    rig.pass_time(SECOND)
    assert rig.changes[2:] == [("manual_drive", True)]
    rig.assert_counters_balance()


def test_at_the_end_only_the_deadman_of_who_drives_has_a_last_word(rig: Rig) -> None:
    operator_drives(rig, SECOND)
    software_drives(rig, SECOND)
    for timer in rig.timers:
        timer.end(rig.now)

    assert brakes(rig) == 1
    assert rig.count("deadman_datagrams_sent", "drive_motor", "driving_board") == 1


def test_what_is_not_sent_to_the_board_takes_nothing_over(rig: Rig) -> None:
    operator_drives(rig, SECOND)
    software_drives(rig, SECOND, distance=FAR)
    rig.arrived_before = SECOND
    software_drives(rig, SECOND)

    assert ("recorder", enveloped(drive_motor={"distance_to_go": FAR, "turning_radius": 1.0})) in rig.sent
    assert rig.changes[0] == ("manual_drive", True)
    assert rig.count("deadman_active", "manual_drive") == 1


def test_a_route_without_a_deadman_takes_over_as_well(rig: Rig) -> None:
    operator_drives(rig, SECOND)
    rig.receive(BRAKE, SENSOR_BOARD)  # another route of the case, which does not go to the board
    rig.pass_time(SECOND)
    assert rig.changes == [("manual_drive", True)]
    rig.receive(BRAKE, BASESTATION)
    rig.pass_time(SECOND)

    assert rig.changes == [("manual_drive", True), ("manual_drive", False)]


def test_without_the_key_a_deadman_waits_for_its_own_commands() -> None:
    rig = Rig(taking_turns("repeat: 100ms"))
    operator_drives(rig, SECOND)
    software_drives(rig, 2 * SECOND)

    assert brakes(rig) == 16
    assert rig.changes == [("manual_drive", True)]


@given(turns=st.lists(st.tuples(st.sampled_from(["operator", "software", "nobody"]), st.integers(1, 900))))
def test_the_board_is_braked_exactly_while_nobody_commands_it(turns: list[tuple[str, int]]) -> None:
    """One deadman at most is armed, so brakes come as from one that hears of every command. Times in ms."""
    rig = Rig(taking_turns(BOTH))
    commands, now = [], 0
    for who, lasting in turns:
        if who == "operator":
            rig.receive(TURN, BASESTATION)
        elif who == "software":
            rig.take("drive_motor", drive(2.0))
        commands += [now] if who != "nobody" else []
        rig.pass_time(lasting * MS)
        now += lasting
    silences = [range(command + 500, until + 1, 100) for command, until in pairwise([*commands, now])]
    assert brakes(rig) == sum(map(len, silences))

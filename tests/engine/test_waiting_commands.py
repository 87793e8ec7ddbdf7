"""Commands that wait for a budget or for `on_limit: latest`: a deadman is told of them when they leave, not before."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.compiler.program import Program
from tests.engine.rig import BASESTATION, HEAD, SENSOR_BOARD, Rig, program
from tests.engine.test_both_directions import BRAKE, MS, SECOND, enveloped
from tests.engine.wire import LEN, framed, tag, varint

HEAD_MORE = HEAD.replace("routes:", "  far_board: {address: 192.168.0.70:8, kind: tool, bandwidth: 10kB/s}\nroutes:")
TURN = enveloped(manual_drive={"turn": 5})
DEADMAN = "deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [far_board]"
PACED = f"""\
  manual_drive:
    - source: basestation
      destinations: [far_board]
      priority: command
      ttl: 200ms
      {DEADMAN}, disarmed_by: [pump_info]}}
  ph_info: {{source: sensor_board, destinations: [far_board], priority: bulk, deadman: {{none: no command at all}}}}
  pump_info: {{source: sensor_board, destinations: [far_board], priority: command, ttl: 200ms,
    deadman: {{none: large commands}}}}
"""
HELD = f"""\
  manual_drive:
    source: basestation
    destinations: [{{endpoint: far_board, max_rate: 3 Hz, on_limit: latest}}]
    ttl: 400ms
    {DEADMAN}}}
"""


def large(number: int, size: int) -> bytes:
    """A payload whose only field nobody knows."""
    return framed(number, tag(30, LEN) + varint(size) + bytes(size))


@pytest.fixture(scope="module")
def paced(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return program(tmp_path_factory.mktemp("paced"), PACED, HEAD_MORE)


@pytest.fixture
def rig(paced: Program) -> Rig:
    return Rig(paced)


def number_of(rig: Rig, case: str) -> int:
    return next(number for number, [handler, *_] in rig.program.inbound.items() if handler.case.name == case)


def drives(rig: Rig, ns: int) -> None:
    """20 commands per second, of the operator."""
    for _ in range(ns // (50 * MS)):
        rig.receive(TURN, BASESTATION)
        rig.pass_time(50 * MS)


def test_commands_beside_more_bulk_than_the_budget_are_neither_late_nor_stale(rig: Rig) -> None:
    bulk = large(number_of(rig, "ph_info"), 15_000)
    for _ in range(20):
        rig.receive(bulk)
        for _ in range(10):
            before = rig.sent.count(("far_board", TURN))
            rig.receive(TURN, BASESTATION)
            assert rig.sent.count(("far_board", TURN)) == before + 1
            rig.pass_time(50 * MS)
    assert rig.dropped("manual_drive", "far_board") == {}
    assert rig.changes == []
    assert rig.count("datagrams_sent", "ph_info", "far_board") * len(bulk) == pytest.approx(90_000, abs=15_001)
    rig.pass_time(100 * SECOND)
    rig.assert_counters_balance()


def test_it_trips_when_all_commands_are_dropped(tmp_path: Path) -> None:
    """Another source's command takes the commands' part of the budget for almost three seconds."""
    table = PACED.replace(", disarmed_by: [pump_info]", "")
    rig = Rig(program(tmp_path, table, HEAD_MORE.replace("10kB/s", "5kB/s")))
    drives(rig, SECOND)
    rig.receive(large(number_of(rig, "pump_info"), 16_000), SENSOR_BOARD)
    drives(rig, 2 * SECOND)

    assert rig.changes == [("manual_drive", True)]
    assert rig.sent.count(("far_board", BRAKE)) == 16
    assert rig.dropped("manual_drive", "far_board")["stale"] >= 36
    drives(rig, 2 * SECOND)
    assert rig.changes == [("manual_drive", True), ("manual_drive", False)]
    assert rig.sent[-1] == ("far_board", TURN)
    rig.pass_time(SECOND)
    rig.assert_counters_balance()


def test_one_that_takes_over_disarms_it_when_it_leaves_and_not_when_it_is_dropped(rig: Rig) -> None:
    """After a large command, the next one is stale before it may leave."""
    large_turn, large_pump = (large(number_of(rig, case), 16_000) for case in ("manual_drive", "pump_info"))
    rig.receive(large_turn, BASESTATION)
    rig.receive(large(number_of(rig, "pump_info"), 0))
    rig.pass_time(500 * MS)
    assert rig.dropped("pump_info", "far_board") == {"stale": 1}
    assert rig.changes == [("manual_drive", True)]

    rig.pass_time(2 * SECOND)
    rig.receive(large_pump)
    assert rig.changes == [("manual_drive", True), ("manual_drive", False)]
    rig.receive(TURN, BASESTATION)
    rig.pass_time(SECOND)
    assert rig.dropped("manual_drive", "far_board") == {"stale": 1}
    assert len(rig.changes) == 2


def test_what_is_held_back_for_a_rate_feeds_it_when_it_leaves(tmp_path: Path) -> None:
    rig = Rig(program(tmp_path, HELD, HEAD_MORE))
    rig.receive(TURN, BASESTATION)
    rig.pass_time(100 * MS)
    rig.receive(TURN, BASESTATION)  # held back until 167 ms
    rig.pass_time(501 * MS)
    assert [data for _, data in rig.sent] == [TURN, TURN]
    assert rig.changes == []
    rig.pass_time(67 * MS)
    assert rig.changes == [("manual_drive", True)]


def test_what_a_board_cannot_take_does_not_replace_what_is_held(tmp_path: Path) -> None:
    head = HEAD.replace("routes:", "  far_board: {address: 192.168.0.70:8, kind: board}\nroutes:")
    held = (
        "  imu_info: {source: sensor_board, destinations: [{endpoint: far_board, max_rate: 1 Hz, on_limit: latest}]}\n"
    )
    rig = Rig(program(tmp_path, held, head))
    first, good, bad = (enveloped(imu_info={"accel_x": value}) for value in (1, 2, float("nan")))
    for datagram in (first, good, bad):
        rig.receive(datagram, SENSOR_BOARD)
    rig.pass_time(2 * SECOND)
    assert rig.sent == [("far_board", first), ("far_board", good)]
    assert rig.dropped("imu_info", "far_board") == {"non_finite": 1}


def test_what_a_board_cannot_take_feeds_no_deadman(tmp_path: Path) -> None:
    deadman = "deadman: {timeout: 500ms, send: {arm_ctrl: {}}}"
    table = f"  arm_ctrl: {{source: basestation, destinations: [driving_board], {deadman}}}\n"
    rig = Rig(program(tmp_path, table))
    rig.receive(enveloped(arm_ctrl={"control_base": 1}), BASESTATION)
    for _ in range(12):
        rig.pass_time(50 * MS)
        rig.receive(enveloped(arm_ctrl={"control_base": float("inf")}), BASESTATION)
    assert rig.changes == [("arm_ctrl", True)]
    assert rig.dropped("arm_ctrl", "driving_board") == {"non_finite": 12}

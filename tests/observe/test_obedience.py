"""What boards show about brakes, as people read it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from textwrap import dedent

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Answer, Evidence
from router.datagrams import Wire
from router.observe.obedience import Obedience, Reply, why_disobeyed
from tests.tables import ROUTES

ROUTE, BOARD = "manual_drive", "driving_board"


@cache
def program(folder: Path) -> CompiledTable:
    """The rover's program with an `obeyed` that reads two motors and a state."""
    (folder / "table.yaml").write_text(
        dedent(f"""\
            version: 1
            extends: {ROUTES / "rover.yaml"}
            routes:
              manual_drive:
                deadman:
                  obeyed:
                    drive_diag: >-
                      has(front_left_motor) and has(back_left_motor) and abs(front_left_motor.rpm) < 5
                      and abs(back_left_motor.rpm) < 5 and state == DrivingBoardDiagnostics.State.IDLE
                      and has(front_right_motor) and has(back_right_motor)
                    within: 2s
            """)
    )
    made = check_table(folder / "table.yaml").program
    assert made is not None
    return made


@pytest.fixture
def rover(tmp_path_factory: pytest.TempPathFactory) -> CompiledTable:
    return program(tmp_path_factory.getbasetemp())


def drive_diag(program: CompiledTable, **fields: object) -> Evidence:
    case = program.envelopes.first.cases["drive_diag"]
    return Evidence(ROUTE, BOARD, Wire(program.envelopes).encode(case, case.message_class(**fields)))


MOTORS = {f"{end}_{side}_motor": {"rpm": 0.5} for end in ("front", "back") for side in ("left", "right")}


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({**MOTORS, "state": 1}, "state=OPERATING, front_left_motor.rpm=0.5, back_left_motor.rpm=0.5"),
        ({**MOTORS, "front_left_motor": {"rpm": 123.456}}, "front_left_motor.rpm=123, back_left_motor.rpm=0.5"),
        ({"state": 1}, "state=OPERATING, no front_left_motor, no back_left_motor, no front_right_motor, and 1 more"),
    ],
)
def test_of_a_message_the_fields_of_the_condition_are_said(
    rover: CompiledTable, fields: Mapping[str, object], said: str
) -> None:
    obedience = Obedience()
    obedience.note(drive_diag(rover, **fields), rover)
    text = why_disobeyed(rover, ROUTE, BOARD, obedience.replies())
    assert text == f"it was sent manual_brake {{brake: true}}, and says drive_diag {said}"


def test_a_board_that_says_nothing_is_said(rover: CompiledTable) -> None:
    text = why_disobeyed(rover, ROUTE, BOARD, Obedience().replies())
    assert text == "it was sent manual_brake {brake: true}, and has sent no drive_diag since"


def test_replies_last_until_the_deadman_changes(rover: CompiledTable) -> None:
    obedience = Obedience()
    obedience.note(drive_diag(rover, state=1), rover)
    obedience.answered(Answer(ROUTE, BOARD, True, 432_000_000), rover)
    assert obedience.replies() == {(ROUTE, BOARD): Reply(0.432)}
    obedience.forget("drive_motor")
    assert obedience.replies()
    obedience.forget(ROUTE)
    assert obedience.replies() == {}


def test_what_a_reload_has_made_unreadable_is_skipped(rover: CompiledTable) -> None:
    obedience = Obedience()
    obedience.note(Evidence(ROUTE, BOARD, b"\xff"), rover)
    obedience.note(Evidence("drive_motor", BOARD, drive_diag(rover).data), rover)
    obedience.answered(Answer("drive_motor", BOARD, False, 1), rover)
    assert obedience.replies() == {}

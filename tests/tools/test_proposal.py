"""`router init --protos`: which message it takes for the envelope, and a table that is right as it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main
from router.compiler import check_table
from router.errors import Located, SourceSpan
from router.tools.proposal import Choice, candidates
from router.types.protobuf import load_folder

ONEOF = """
    message Pose { float x = 1; double y = 2; int64 stamp = 3; bool on = 4; Kind kind = 5; Inner inner = 6; }
    enum Kind { UNKNOWN = 0; WHEELED = 1; }
    message Inner { uint32 from = 1; repeated float samples = 2; }
    message Name { string text = 1; bytes raw = 2; }
    message Nothing {}
    message FromRobot { uint32 reqId = 1; oneof payload { Pose pose = 2; Nothing nothing = 3; Name yes = 4; } }
    message ToRobot { optional uint32 reqId = 1; oneof payload { Pose pose = 2; } }
"""
CASES = "message Packet { Ball ball = 1; Ball robot = 2; uint32 number = 3; } message Ball { float x = 1; }"
NAMED = "message Wrapped { string name = 1; bytes data = 2; } message Drive { float speed = 1; } message Arm {}"
WHOLE = "message RefereeState { uint32 stage = 1; Team blue = 2; } message Team { string name = 1; }"


def protos(folder: Path, text: str) -> Path:
    path = folder / "protos"
    path.mkdir()
    (path / "robot.proto").write_text(f'syntax = "proto3";\npackage robo;\n{text}', encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "envelope", "choice", "settings", "cases"),
    [
        (ONEOF, "FromRobot", Choice.ONEOF, {"oneof": "payload"}, ["pose", "nothing", "yes"]),
        (CASES, "Packet", Choice.CASES, {"cases": "[ball, robot]"}, ["ball", "robot"]),
        (NAMED, "Wrapped", Choice.NAMED, {"case": "name", "payload": "data"}, ["robo.Drive", "robo.Arm"]),
        (WHOLE, "RefereeState", Choice.WHOLE, {"case": "referee_state"}, ["referee_state"]),
    ],
)
def test_the_likeliest_envelope(
    tmp_path: Path, text: str, envelope: str, choice: Choice, settings: dict[str, str], cases: list[str]
) -> None:
    first = candidates(load_folder(Located(protos(tmp_path, text), SourceSpan("protos"))))[0]
    assert (first.message.short_name, first.choice) == (envelope, choice)
    assert (first.settings, [*first.cases]) == (settings, cases)


@pytest.mark.parametrize("text", [ONEOF, CASES, NAMED, WHOLE])
def test_a_proposed_table_is_right(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "robot"
    assert main(["init", str(folder), "--protos", str(protos(tmp_path, text))]) == OK
    assert not capsys.readouterr().err
    checked = check_table(folder / "routes" / "rover.yaml")
    assert checked.table is not None
    assert not checked.diagnostics


def test_a_proposed_table_shows_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    assert main(["init", str(folder), "--protos", str(protos(tmp_path, ONEOF))]) == OK
    text = (folder / "routes" / "rover.yaml").read_text(encoding="utf-8")
    assert "data: [x, y, float64(stamp), int(message.on), int(kind), inner.from]" in text
    assert "topics: {topic: nothing, type: std_msgs/msg/Empty, fields: {}}" in text
    assert "topics: {topic: 'yes', type: std_msgs/msg/String, fields: {data: text}}" in text
    assert "Not in this envelope: robo.ToRobot." in text


def test_another_envelope_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(protos(tmp_path, ONEOF))
    assert main(["init", str(tmp_path / "a"), "--protos", path, "--message", "ToRobot"]) == OK
    assert "robo.ToRobot, 1 payload case" in capsys.readouterr().out
    assert main(["init", str(tmp_path / "b"), "--protos", path, "--message", "ToRobo"]) == BAD_USAGE
    assert "did you mean 'robo.ToRobot'?" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "routes").mkdir()
    assert main(["init", str(tmp_path), "--protos", str(protos(tmp_path, ONEOF))]) == BAD_USAGE
    assert "already exists; nothing was written" in capsys.readouterr().err


def test_protos_that_protoc_refuses_are_findings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path / "robot"), "--protos", str(protos(tmp_path, "message Pose {"))]) == BAD_TABLE
    assert "robot.proto" in capsys.readouterr().err
    assert not (tmp_path / "robot").exists()


def test_a_message_without_protos_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path / "robot"), "--message", "ToRobot"]) == BAD_USAGE
    assert "--protos DIR" in capsys.readouterr().err

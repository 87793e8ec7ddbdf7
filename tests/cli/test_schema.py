"""`router schema lock`: adds, never takes back."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from router.cli import main
from tests.tables import PROTOS

PROTO = """\
syntax = "proto3";
message Motor {
  float rpm = 1;
}
message Envelope {
  oneof payload {
    Motor motor = 1;
  }
}
"""


@pytest.fixture
def proto(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only `.proto` file of the working directory."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "motor.proto"
    path.write_text(PROTO)
    return path


def lock(*more: str) -> int:
    return main(["schema", "lock", "--protos", ".", *more])


def test_first_lock_is_written_and_the_second_changes_nothing(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lock("--message", "Envelope") == 0
    assert capsys.readouterr().out == (
        "envelope.lock.json: 2 messages, 2 new numbers; an envelope takes up to 7 bytes\n"
    )
    path = proto.with_name("envelope.lock.json")
    before = path.stat()
    assert lock() == 0, "the envelope's name is in the lock by now"
    assert "0 new numbers" in capsys.readouterr().out
    assert path.stat().st_ino == before.st_ino


def test_additions_are_recorded(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock("--message", "Envelope")
    proto.write_text(PROTO.replace("float rpm = 1;", "float rpm = 1;\n  bool on = 2;"))
    capsys.readouterr()
    assert lock() == 0
    assert capsys.readouterr().out == (
        "envelope.lock.json: 2 messages, 1 new number; an envelope takes up to 9 bytes (it was 7: flash the boards)\n"
    )
    locked = json.loads(proto.with_name("envelope.lock.json").read_text())
    assert locked["messages"]["Motor"]["fields"] == {"1": "float rpm", "2": "bool on"}


def test_broken_lock_is_refused(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    proto.with_name("envelope.lock.json").write_text("{")
    assert lock("--message", "Envelope") == 78
    assert "error[bad-file]: not a lock file" in capsys.readouterr().err


def test_unknown_envelope_is_refused(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lock("--message", "Envelop") == 78
    assert "did you mean 'Envelope'?" in capsys.readouterr().err


def test_rovers_lock_is_as_the_command_writes_it(tmp_path: Path) -> None:
    protos = shutil.copytree(PROTOS, tmp_path / "protos")
    lock_file = protos / "envelope.lock.json"
    committed = lock_file.read_text()
    lock_file.unlink()
    assert main(["schema", "lock", "--protos", str(protos)]) == 0
    assert lock_file.read_text() == committed


BROKEN = PROTO.replace("float rpm = 1;", "int32 rpm = 1;\n  bool on = 2;").replace("motor = 1", "motor = 3")


def test_what_is_accepted_by_name_is_recorded_and_the_rest_refused(
    proto: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lock("--message", "Envelope")
    proto.write_text(BROKEN)
    capsys.readouterr()
    assert lock("--accept", "Motor.rpm") == 78
    out = capsys.readouterr().out
    assert "Envelope.motor has number 3 instead of 1" in out
    assert "Motor.rpm is of type" not in out
    assert out.endswith(
        "; if all of it is intended, say so in one command: --accept Motor.rpm --accept Envelope.motor\n"
    )
    assert lock("--accept", "Motor.rpm", "--accept", "Envelope.motor") == 0
    assert capsys.readouterr().out == (
        "accepted: Motor.rpm is of type int32 instead of float\n"
        "accepted: Envelope.motor has number 3 instead of 1\n"
        "envelope.lock.json: 2 messages, 2 new numbers; an envelope takes up to 15 bytes (it was 7: flash the boards)\n"
    )
    locked = json.loads(proto.with_name("envelope.lock.json").read_text())["messages"]
    assert locked["Motor"]["fields"] == {"1": "int32 rpm", "2": "bool on"}
    assert locked["Envelope"]["fields"] == {"3": "oneof payload: Motor motor"}
    assert lock() == 0


def test_a_whole_message_is_accepted_without_those_nested_in_it(
    proto: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nested = PROTO.replace("float rpm = 1;", "float rpm = 1;\n  enum State {\n    IDLE = 0;\n    BUSY = 1;\n  }")
    proto.write_text(nested)
    lock("--message", "Envelope")
    proto.write_text(nested.replace("rpm = 1", "rpm = 2").replace("BUSY = 1", "BUSY = 3"))
    assert lock("--accept", "Motor") == 78
    assert lock("--accept", "Motor", "--accept", "Motor.State.BUSY") == 0


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (
            "Motor.rmp",
            BROKEN,
            "'Motor.rmp' has nothing to accept; nothing was written\nhelp: did you mean 'Motor.rpm'?",
        ),
        ("Motor.on", BROKEN, "'Motor.on' has nothing to accept; nothing was written\nhelp: did you mean"),
        (
            "Motor.rpm",
            PROTO,
            "'Motor.rpm' has nothing to accept; nothing was written\nhelp: nothing conflicts with the lock",
        ),
    ],
)
def test_a_name_without_a_conflict_is_refused(
    proto: Path, capsys: pytest.CaptureFixture[str], name: str, text: str, said: str
) -> None:
    lock("--message", "Envelope")
    path = proto.with_name("envelope.lock.json")
    before = path.read_text()
    proto.write_text(text)
    assert lock("--accept", name) == 2
    assert said in capsys.readouterr().err
    assert path.read_text() == before


def test_another_envelope_is_accepted_by_its_name(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock("--message", "Envelope")
    proto.write_text(PROTO.replace("message Envelope", "message RoverEnvelope"))
    assert lock("--message", "RoverEnvelope") == 78
    assert "the lock is for the envelope Envelope.payload, not RoverEnvelope.payload" in capsys.readouterr().out
    assert lock("--message", "RoverEnvelope", "--accept", "RoverEnvelope") == 0
    assert lock() == 0


def test_the_lock_is_where_the_table_says(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command that the finding prints writes it, and then there is no finding."""
    table = proto.with_name("table.yaml")
    table.write_text(
        "version: 1\n"
        "envelope: {protos: 'sub module', message: Envelope, oneof: payload, lock: locks/wire.json}\n"
        "listen: {rover: {address: 127.0.0.1:5000}}\n"
        "endpoints: {board: {address: 127.0.0.30:8, kind: board}}\n"
        "routes: {motor: {ignore: not part of this test}}\n"
    )
    for name in ("sub module", "locks"):
        proto.with_name(name).mkdir()
    proto.rename(proto.parent / "sub module" / "motor.proto")
    assert main(["validate", str(table)]) == 78
    said = capsys.readouterr().out
    assert "table.yaml:2:75: error[bad-file]: there is no lock file locks/wire.json" in said
    command = re.search(r"`router (.*?)`", said)
    assert command is not None
    assert main(shlex.split(command[1])) == 0
    assert [path.name for path in (proto.parent / "sub module").iterdir()] == ["motor.proto"]
    assert main(["validate", "--strict", str(table)]) == 0
    motor = proto.parent / "sub module" / "motor.proto"
    motor.write_text(PROTO.replace("float", "int32"))
    capsys.readouterr()
    assert main(["validate", "--strict", str(table)]) == 78
    command = re.search(r"intended, `router (.*?)`", capsys.readouterr().out)
    assert command is not None
    assert main(shlex.split(command[1])) == 0
    assert main(["validate", "--strict", str(table)]) == 0

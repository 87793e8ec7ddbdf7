"""`router schema lock`: adds, never takes back."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from router.assets import asset
from router.cli import main

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


def test_conflict_is_refused_and_nothing_written(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock("--message", "Envelope")
    path = proto.with_name("envelope.lock.json")
    before = path.read_text()
    proto.write_text(PROTO.replace("float rpm = 1;", "float rpm = 3;\n  bool on = 2;"))
    capsys.readouterr()
    assert lock() == 78
    assert capsys.readouterr().out == (
        "motor.proto:3:15: error[wire-number-conflict]: Motor.rpm has number 3 instead of 1; "
        "the lock says `float rpm = 1`; if it is intended, `router schema lock --protos . --accept Motor.rpm`\n"
        "    3 |   float rpm = 3;\n"
        "      |               ^\n"
    )
    assert path.read_text() == before


def test_broken_lock_is_refused(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    proto.with_name("envelope.lock.json").write_text("{")
    assert lock("--message", "Envelope") == 78
    assert "error[bad-file]: not a lock file" in capsys.readouterr().err


def test_unknown_envelope_is_refused(proto: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lock("--message", "Envelop") == 78
    assert "did you mean 'Envelope'?" in capsys.readouterr().err


def test_rovers_lock_is_as_the_command_writes_it(tmp_path: Path) -> None:
    protos = shutil.copytree(asset("protos"), tmp_path / "protos")
    lock_file = protos / "envelope.lock.json"
    committed = lock_file.read_text()
    lock_file.unlink()
    assert main(["schema", "lock", "--protos", str(protos)]) == 0
    assert lock_file.read_text() == committed

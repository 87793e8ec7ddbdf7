"""The lock file and `router new` for envelopes without a oneof."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main
from router.compiler import check_table
from router.datagrams import why_rejected

REFEREE = 'syntax = "proto3";\nmessage Referee { uint32 sequence = 1; }\n'
TABLE = """version: 1
envelope: {protos: protos, CHOICE}
listen: {rover: {address: 127.0.0.1:5000}}
endpoints: {board: {address: 127.0.0.2:8, kind: tool}}
routes: {ROUTES}
"""
FRAME = "message: Referee, case: referee"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "a.proto").write_text(REFEREE)
    return tmp_path


def write_table(folder: Path, choice: str, case: str = "referee") -> None:
    routes = f"{case}: {{source: any, destinations: [board]}}"
    (folder / "table.yaml").write_text(TABLE.replace("CHOICE", choice).replace("ROUTES", routes))


def test_the_lock_records_how_a_frame_holds_messages(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_table(folder, FRAME)
    assert main(["validate", "--strict", "table.yaml"]) == BAD_TABLE
    assert "create it with `router schema lock --table table.yaml`" in capsys.readouterr().out
    assert main(["schema", "lock", "--table", "table.yaml"]) == OK
    assert main(["validate", "--strict", "table.yaml"]) == OK
    lock = json.loads((folder / "protos" / "envelope.lock.json").read_text())
    assert lock["envelope"] == {"message": "Referee", "by": "frame", "max_size": 6}
    write_table(folder, "message: Referee, case: judge", "judge")  # the name is not on the wire
    assert main(["validate", "--strict", "table.yaml"]) == OK


def test_another_message_is_a_conflict(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_table(folder, FRAME)
    main(["schema", "lock", "--table", "table.yaml"])
    (folder / "protos" / "a.proto").write_text(REFEREE + "message Other { Referee referee = 1; }\n")
    write_table(folder, "message: Other, case: referee")
    assert main(["validate", "table.yaml"]) == BAD_TABLE
    assert "the lock is for the envelope Referee (by frame), not Other (by frame)" in capsys.readouterr().out


def test_the_protos_alone_do_not_say_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_table(folder, FRAME)
    main(["schema", "lock", "--table", "table.yaml"])
    assert main(["schema", "lock", "--protos", "protos"]) == BAD_USAGE
    assert "--table FILE" in capsys.readouterr().err


def test_new_messages_are_members_of_a_oneof(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_table(folder, FRAME)
    assert main(["new", "BoardState", "--number", "2", "--board", "board", "-t", "table.yaml"]) == BAD_USAGE
    assert "an envelope without a oneof" in capsys.readouterr().err


NAMED = "message: Wrapped, case: name, payload: data"
WRAPPED = """syntax = "proto3";
message Wrapped { string name = 1; bytes data = 2; }
message Part { uint32 number = 1; }
message Whole { repeated Part parts = 1; Whole inner = 2; message Nested { bool flag = 1; } }
"""


def test_each_message_is_a_case_and_parts_of_others_need_no_route(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "protos" / "a.proto").write_text(REFEREE)
    (folder / "protos" / "b.proto").write_text(WRAPPED)
    write_table(folder, NAMED, "Referee")
    assert main(["schema", "lock", "--table", "table.yaml"]) == OK
    lock = json.loads((folder / "protos" / "envelope.lock.json").read_text())
    assert lock["envelope"]["by"] == "name: name, data"
    assert lock["messages"].keys() == {"Referee", "Wrapped", "Part", "Whole", "Whole.Nested"}
    assert main(["validate", "table.yaml"]) == OK
    assert "no route for the payload case Whole\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"\x0a\x07referee", "'referee' (known: Referee)"),
        (b"\x0a\x09x/Referee", "'x/Referee' (known: Referee)"),
        (b"\x0a\x0da.b.c.Referee", "'a.b.c.Referee' (known: Referee)"),
        (b"\x0a\x04Nope", "'Nope'"),
        (b"\x0a\x07Referee\x12\x01\x07", "the payload is not a valid Referee"),
        (b"\x08\x01", "field 1 is not text"),
        (b"\x0a\x07Referee\x10\x01", "field 2 is not bytes"),
        (b"\x12\x02\x08\x01", ""),
        (b"", ""),
    ],
)
def test_what_is_wrong_is_said(folder: Path, data: bytes, why: str) -> None:
    (folder / "protos" / "b.proto").write_text(WRAPPED)
    write_table(folder, NAMED, "Referee")
    envelopes = check_table(folder / "table.yaml", {}).envelopes
    assert envelopes is not None
    said, _, _ = why_rejected(envelopes.first, data, len(data), repairs=True).partition("; ")  # guesses follow
    assert said == why


def test_fields_beside_each_other_are_locked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "protos" / "b.proto").write_text(
        'syntax = "proto3"; import "a.proto"; message Packet { Referee referee = 2; Referee judge = 1; uint32 at = 3; }'
    )
    write_table(folder, "message: Packet, cases: [referee]")
    assert main(["schema", "lock", "--table", "table.yaml"]) == OK
    assert main(["validate", "--strict", "table.yaml"]) == OK
    lock = json.loads((folder / "protos" / "envelope.lock.json").read_text())
    assert lock["envelope"] == {"message": "Packet", "by": "cases", "max_size": 22}
    write_table(folder, "message: Packet, cases: [referee, judge]")
    assert main(["validate", "--strict", "table.yaml"]) == BAD_TABLE
    assert "no route for the payload case judge" in capsys.readouterr().out


def test_a_required_message_is_not_one_of_several(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "protos" / "b.proto").write_text(
        'syntax = "proto2"; import "a.proto"; message Packet { required Referee referee = 2; }'
    )
    write_table(folder, "message: Packet, cases: [referee]")
    assert main(["validate", "table.yaml"]) == BAD_TABLE
    assert "'referee' of Packet is required, but each message goes on without the others" in capsys.readouterr().out

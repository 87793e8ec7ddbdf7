"""The check of a table as a whole."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import pytest

from router.compiler import check, check_table
from router.errors import Code
from router.image.writer import write_image
from tests.bad_tables.corpus import HERE
from tests.recording.test_choices import TABLES
from tests.tables import ROUTES


def test_no_garbage_is_collected_while_a_table_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    enabled: list[bool] = []

    def noted(_: object) -> list[Any]:
        enabled.append(gc.isenabled())
        return []

    monkeypatch.setattr(check, "check_gateways", noted)
    check_table(ROUTES / "rover.yaml", {})
    assert (enabled, gc.isenabled()) == ([False], True)


def test_collection_goes_on_after_a_mistake_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "load_table", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        check_table(ROUTES / "rover.yaml", {})
    assert gc.isenabled()


@pytest.mark.parametrize("name", ["rover", "sim", "legacy"])
def test_every_process_makes_the_same_program(name: str) -> None:
    """Also the same image of it, byte for byte. The order of sets differs among processes."""
    made = [
        subprocess.run(
            [sys.executable, "-m", __name__, ROUTES / f"{name}.yaml"],
            env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert len(made[0]) > 10_000
    assert made[0] == made[1]


BESIDE = """
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload{because}}}
listen: {{rover: {{address: 127.0.0.1:5000}}}}
endpoints:
  board: {{address: 127.0.0.2:8, kind: board}}
  base: {{address: 127.0.0.3:9000, kind: basestation}}
routes:
  halt: {{source: base, destinations: board, deadman: {{none: it stops the board}}}}
  drive: {drive}
"""
SPEED = "source: {topic: speed, type: std_msgs/msg/Float32}, fields: {speed: data}"
TO_BASE = "ttl: 1s, deadman: {timeout: 1s, send: {drive: {}}, because: it is a test}"


@pytest.mark.parametrize(
    ("drive", "because", "empty", "lacks"),
    [
        ("{source: base, destinations: board, deadman: {none: it is a test}}", "", False, False),  # forwarded
        ("{source: base, destinations: board, ttl: 1s, deadman: {timeout: 1s, send: {drive: {}}}}", "", True, True),
        (f"{{{SPEED}, destinations: board, deadman: {{none: it is a test}}}}", "", True, True),
        (f"{{{SPEED}, destinations: board, deadman: {{none: it is a test}}}}", ", because: a test", False, True),
        (f"{{{SPEED}, destinations: base}}", "", False, True),
        (f"{{source: board, destinations: base, {TO_BASE}}}", "", False, True),
    ],
)
def test_fields_beside_the_payload_are_empty_in_what_the_router_makes(
    tmp_path: Path, drive: str, because: str, empty: bool, lacks: bool
) -> None:
    """That is a warning for boards, and an error if the field is required: nobody can decode the envelope."""
    table = tmp_path / "table.yaml"
    for protos, code, is_found in (("beside", Code.EMPTY_FIELD, empty), ("must", Code.MISSING_KEY, lacks)):
        table.write_text(BESIDE.format(protos=HERE / "protos" / protos, because=because, drive=drive))
        assert [each.code for each in check_table(table, {}).diagnostics] == [code] * is_found


def test_set_fills_what_the_envelope_requires_for_its_endpoint_only(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    drive = f"{{{SPEED}, destinations: [board, base], deadman: {{none: it is a test}}}}"
    text = BESIDE.format(protos=HERE / "protos" / "must", because="", drive=drive)
    ends = ("kind: board", "kind: basestation")
    for filled, lacking in ((ends, []), (ends[:1], ["'base'"]), (ends[1:], ["'board'"])):
        written = text
        for end in filled:
            written = written.replace(end, f"{end}, set: {{sequence: 7}}")
        table.write_text(written)
        found = check_table(table, {}).diagnostics
        assert [(each.code, each.message.rpartition(" ")[2]) for each in found] == [
            (Code.MISSING_KEY, name) for name in lacking
        ]


@pytest.mark.parametrize(
    ("drive", "unused"),
    [
        ("{source: base, destinations: board, deadman: {none: it is a test}}", ["board", "base"]),
        ("{source: base, destinations: board, ttl: 1s, deadman: {timeout: 1s, send: {drive: {}}}}", ["base"]),
        ("{source: base, destinations: board, ttl: 1s, deadman: {timeout: 1s, send: {driv: {}}}}", []),  # an error
        (f"{{{SPEED}, destinations: [board, base], deadman: {{none: it is a test}}}}", []),
        (f"{{source: board, destinations: base, {TO_BASE}}}", ["board"]),
    ],
)
def test_set_is_unused_where_the_router_only_forwards(tmp_path: Path, drive: str, unused: list[str]) -> None:
    table = tmp_path / "table.yaml"
    text = BESIDE.format(protos=HERE / "protos" / "must", because="", drive=drive)
    for end in ("kind: board", "kind: basestation"):
        text = text.replace(end, f"{end}, set: {{sequence: 7}}")
    table.write_text(text)
    found = [each.message for each in check_table(table, {}).diagnostics if each.code is Code.UNUSED_SET]
    message = "'set' of '{}' fills nothing: the router makes no message for it"
    assert found == [message.format(name) for name in unused]


def test_types_of_protobuf_itself_are_no_cases_of_an_envelope_with_names(tmp_path: Path) -> None:
    (tmp_path / "wrapped.proto").write_text(
        'syntax = "proto3"; import "google/protobuf/timestamp.proto";'
        "message Wrapped { string name = 1; bytes data = 2; }"
        "message At { google.protobuf.Timestamp time = 1; }"
    )
    table = tmp_path / "table.yaml"
    table.write_text(
        f"version: 1\nenvelope: {{protos: {tmp_path}, message: Wrapped, case: name, payload: data}}\n"
        "listen: {rover: {address: 127.0.0.1:5000}}\nendpoints: {tool: {address: 127.0.0.3:9000, kind: tool}}\n"
        "routes: {At: {source: any, destinations: tool}}\n"
    )
    checked = check_table(table, {})
    assert [each.code for each in checked.diagnostics] == [Code.NOT_LOCKED]
    assert checked.program is not None
    assert [*checked.program.envelopes.cases] == ["At"]


def test_set_is_refused_where_a_datagram_is_the_payload_itself(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    framed = TABLES / "framed"
    text = (TABLES / "framed.yaml").read_text().replace("protos: framed", f"protos: {framed}")
    table.write_text(text.replace("kind: board}", "kind: board, set: {sequence: sequence}}"))
    [found] = [each for each in check_table(table, {}).diagnostics if each.code is not Code.NOT_LOCKED]
    assert (found.code, found.message) == (
        Code.UNKNOWN_FIELD,
        "Referee is the payload 'referee' itself, so no fields are beside it",
    )


def plain(value: Any) -> Any:
    """What a part of a program consists of: the order of a set alone does not count."""
    if isinstance(value, (set, frozenset)):
        return sorted(map(repr, value))
    if isinstance(value, dict):
        return [(key, plain(part)) for key, part in value.items()]
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *(plain(getattr(value, each.name)) for each in fields(value))]
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if value is None or isinstance(value, (bool, int, float, str, bytes, Enum, Path)):
        return value
    return type(value).__name__


if __name__ == "__main__":
    checked = check_table(Path(sys.argv[1]), {})
    program = checked.program
    assert program is not None
    print(
        plain([checked.diagnostics, [*program.counters.series()], program.lowered, program.inbound, program.outbound])
    )
    print(plain([program.senders, program.publishers, program.subscriptions, program.deadmen, program.boards]))
    print(*sorted(write_image(program).parts().items()))

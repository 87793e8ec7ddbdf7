"""`router explain --code` lists what is read of a message, and each operation with its place in the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.cli import OK, main

PROTO = """\
syntax = "proto3";
message Motor { int32 speed = 1; string name = 2; }
message Reading { float value = 1; repeated Motor motors = 2; repeated float xs = 3; optional int32 n = 4; }
message Order { string name = 1; repeated uint32 path = 2; }
message PBEnvelope { oneof payload { Reading reading = 1; Order order = 2; Reading other = 3; Motor motor = 4; } }
"""
TABLE = """\
version: 1
envelope: {protos: ., message: PBEnvelope, oneof: payload}
listen: {here: {address: "127.0.0.1:25000"}}
endpoints: {board: {address: "127.0.0.2:8", kind: tool}, pc: {address: "127.0.0.3:8", kind: tool}}
routes:
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "own.proto").write_text(PROTO)
    monkeypatch.chdir(tmp_path)
    return Path("t.yaml")


def listed(capsys: pytest.CaptureFixture[str], site: Path, routes: str) -> str:
    """What follows the words about the route."""
    site.write_text(TABLE + routes)
    assert main(["explain", "--code", "--table", str(site)]) == OK
    told = capsys.readouterr().out
    return told[told.index("\n\n  reads ") + 2 :]


def test_a_condition_is_listed_with_what_it_reads_and_where_it_jumps(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    route = "  reading: {source: board, destinations: [{endpoint: pc, when: value > 1 and has(n)}]}\n"
    assert listed(capsys, site, route) == (
        "  reads Reading, node 0\n"
        "    field 1: float -> slot 3  value\n"
        "    field 4: int32 -> slot 5  has(n)\n"
        "    oneof -> slot 4  member of _n\n"
        "\n"
        "  reads PBEnvelope, node 1\n"
        "    field 1: message -> node 0\n"
        "    oneof -> slot 2  member of payload\n"
        "\n"
        "  destination pc\n"
        "    # when  (t.yaml:6:64)\n"
        "       0  integer           1\n"
        "       1  load              slot 3  value\n"
        "       2  compare           <  signed_with_real\n"
        "       3  and               to 5\n"
        "       4  load              slot 5  has(n)\n"
        "\n"
    )


def test_loops_are_indented_and_each_place_is_named_once(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topic = "{topic: b, type: diagnostic_msgs/msg/DiagnosticArray, fields: {status: motors}}"
    told = listed(capsys, site, f"  reading:\n    source: board\n    topics: [{topic}]\n")
    assert "    field 2: repeated message -> slot 5  motors\n" in told
    assert "  reads Motor, node 2\n    field 2: bytes -> slot 6  motors[].name\n" in told
    assert told[told.index("  topic b\n") :] == (
        "  topic b\n"
        "    # t.yaml:8:68\n"
        "       0  known             00 01 00 00 00 00 00 00 00 00 00 00 01 00 00 00 ... (17 bytes)\n"
        "    # status  (t.yaml:8:85)\n"
        "       1  load              slot 5  motors\n"
        "       2  keep              slot 2\n"
        "       3  size\n"
        "       4  keep              slot 3\n"
        "       5  put               4 bytes\n"
        "       6  load              slot 3\n"
        "       7  repeat            up to 14\n"
        "       8    next              slot 2\n"
        "       9    enter             node 2, Motor\n"
        "    # status.level  (t.yaml:8:85)\n"
        "      10    known             00\n"
        "    # status.name  (t.yaml:8:85)\n"
        "      11    load              slot 6  motors[].name\n"
        "      12    put_text\n"
        "    # status.message  (t.yaml:8:85)\n"
        "      13    known             01 00 00 00 00 00 00 00 01 00 00 00 00 00 00 00 ... (20 bytes), aligned to 4\n"
        "    # status  (t.yaml:8:85)\n"
        "      14  again\n"
        "\n"
    )


def test_a_message_from_ros_is_listed_with_its_elements(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = "{name: {text: a}, path: '[index, 7]'}"
    route = (
        "  order:\n"
        "    source: {topic: cmd, type: sensor_msgs/msg/JointState}\n"
        "    for_each: velocity\n"
        f"    destinations: [{{endpoint: pc, fields: {fields}}}]\n"
    )
    assert listed(capsys, site, route) == (
        "  reads sensor_msgs/msg/JointState, node 0\n"
        "    skip 8 bytes\n"
        "    skip a sequence, of 1 byte each\n"
        "    each of a sequence\n"
        "      skip a sequence, of 1 byte each\n"
        "    again\n"
        "    skip a sequence, of 8 bytes each\n"
        "    float64[] -> slot 5  velocity\n"
        "\n"
        "  elements, float64 in a row\n"
        "    # for_each  (t.yaml:8:15)\n"
        "       0  load              slot 5  velocity\n"
        "    each -> slot 3  index\n"
        "\n"
        "  destination pc\n"
        "    # t.yaml:9:35\n"
        "       0  open              field 2\n"
        "    # name  (t.yaml:9:57)\n"
        "       1  known             0a 01 61\n"
        "    # path  (t.yaml:9:68)\n"
        "       2  open              field 2, left out if empty\n"
        "    # path  (t.yaml:9:69)\n"
        "       3  load              slot 3  index\n"
        "       4  write_varint      no tag, also if 0 or empty\n"
        "    # path  (t.yaml:9:76)\n"
        "       5  known             07\n"
        "    # path  (t.yaml:9:68)\n"
        "       6  close\n"
        "    # t.yaml:9:35\n"
        "       7  close\n"
        "\n"
    )


def test_what_makes_frames_is_listed_in_front_of_what_fills_topics(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The fields of topics are those of the first payload; `items` has slots of its own."""
    told = listed(
        capsys,
        site,
        "  motor:\n"
        "    source: board\n"
        "    collect: {by: name, count: speed, order: 0, timeout: 1s}\n"
        '    topics: [{topic: b, type: std_msgs/msg/Int32, fields: {data: "items[1].speed"}}]\n',
    )
    assert "  reads Motor, node 2\n    field 1: int32 -> slot 7  items[].speed\n" in told
    assert told[told.index("  frame\n") : told.index("  topic b\n")] == (
        "  frame\n"
        "    # collect  (t.yaml:8:5)\n"
        "       0  load              slot 5  name\n"
        "\n"
        "  its size\n"
        "    # collect  (t.yaml:8:5)\n"
        "       0  load              slot 6  speed\n"
        "\n"
        "  the place in it\n"
        "    # collect  (t.yaml:8:5)\n"
        "       0  integer           0\n"
        "    all of a frame -> slot 2  items\n"
        "\n"
    )

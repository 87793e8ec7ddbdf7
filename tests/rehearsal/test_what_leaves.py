"""What random tables send, as the protobuf library parses it: each kind of envelope, `set`, and lists."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import Message
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from router.carrier.simulation import Output, Simulation
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.errors import Severity
from router.library import library
from router.values.reading import filled

BESIDE = """\
  Header header = 1;
  fixed32 count = 2;
  double sent = 7;
  string label = 9;
  sint32 robot = 16;
"""
PROTO = f"""\
syntax = "proto3";
import "google/protobuf/timestamp.proto";
enum Mode {{ IDLE = 0; AUTO = 1; }}
message Item {{ sint32 id = 1; float x = 2; double y = 3; }}
message Command {{
  repeated Item items = 1; float speed = 2; string name = 3; Mode mode = 4; uint32 id = 5; repeated sint64 numbers = 20;
}}
message Other {{ bool on = 1; }}
message Header {{ uint64 seq = 1; google.protobuf.Timestamp sent_at = 2; }}
message ByOneof {{ {BESIDE} oneof payload {{ Command command = 3; Other other = 4; }} }}
message ByCases {{ {BESIDE} optional Command command = 3; optional Other other = 4; }}
message ByName {{ {BESIDE} string name = 3; bytes data = 4; }}
"""
KINDS = {
    "message: ByOneof, oneof: payload": "command",
    "message: ByCases, cases: [other, command]": "command",
    "message: ByName, case: name, payload: data": "Command",
    "message: Command, case: frame": "frame",
}
"""What a table says about its envelope, and the payload case of a Command."""

NOW = 1_700_000_000_123_456_789
Point = tuple[float, float, float]
Fields = dict[str, Any]

floats = st.floats(width=32, allow_nan=False, allow_infinity=False)
points = st.lists(st.tuples(floats, floats, floats), max_size=4)
integers = st.integers(-(1 << 31), (1 << 31) - 1)
words = st.text("abcxyz", max_size=5)
items = st.lists(
    st.fixed_dictionaries({}, optional={"id": integers, "x": floats, "y": floats}).filter(bool), min_size=1, max_size=3
)

MAPPINGS = st.fixed_dictionaries(
    {"speed": st.just("float32(len(points))")},  # something has to be read
    optional={
        "id": st.integers(0, (1 << 32) - 1),
        "name": words,
        "mode": st.sampled_from(["IDLE", "AUTO"]),
        "numbers": st.lists(st.integers(-(1 << 63), (1 << 63) - 1), min_size=1, max_size=3),
        "items": st.just("each") | items,
    },
)
SETS = st.fixed_dictionaries(
    {},
    optional={
        "header": st.fixed_dictionaries(
            {}, optional={"seq": st.sampled_from(["sequence", 0, 7, (1 << 64) - 1]), "sent_at": st.just("now")}
        ).filter(bool),
        "count": st.sampled_from(["sequence", 0, 9]),
        "sent": st.sampled_from(["now", "now * 1000", 0.0, -1.5]),
        "label": words,
        "robot": integers,
    },
).filter(bool)


def written(values: Any) -> Any:
    """Values as a table has them: what is text there, except for the words of expressions, is marked as text."""
    if isinstance(values, dict):
        return {
            name: {"text": value} if name in ("name", "label") else written(value) for name, value in values.items()
        }
    if isinstance(values, list):
        return [written(value) for value in values]
    return values


def program_of(folder: Path, envelope: str, fields: Fields, beside: Fields) -> CompiledTable:
    (folder / "all.proto").write_text(PROTO)
    table = folder / "table.yaml"
    mapping = written(fields)
    if mapping.get("items") == "each":
        mapping["items"] = {"each": "points", "fields": {"id": "trunc(clamp(x, -9.0, 9.0))", "x": "x", "y": "y"}}
    endpoint = {"address": "127.0.0.2:8", "kind": "tool"} | ({"set": written(beside)} if beside else {})
    route = {
        "source": {"topic": "shape", "type": "geometry_msgs/msg/Polygon"},
        "destinations": "robot",
        "fields": mapping,
    }
    table.write_text(
        f"version: 1\nenvelope: {{protos: ., {envelope}}}\nlisten: {{rover: {{address: 127.0.0.1:5000}}}}\n"
        f"endpoints: {{robot: {json.dumps(endpoint)}}}\nroutes: {{{KINDS[envelope]}: {json.dumps(route)}}}\n"
    )
    checked = check_table(table, {})
    errors = [str(each) for each in checked.diagnostics if each.severity is Severity.ERROR]
    assert checked.program is not None, errors
    return checked.program


def left(program: CompiledTable, shapes: Sequence[Sequence[Point]]) -> list[bytes]:
    """Return what leaves for the robot, which gets these shapes at NOW, and a second later each."""
    simulation = Simulation(library(), NOW)
    simulation.adopt(program)
    sent = []
    for number, shape in enumerate(shapes):
        simulation.advance(NOW + number * 10**9)
        data = b"\0\1\0\0" + struct.pack("<I", len(shape)) + b"".join(struct.pack("<3f", *point) for point in shape)
        simulation.message("shape", data, simulation.now)
        sent += [each.data for each in simulation.records() if isinstance(each, Output)]
    return sent


def expected_payload(made: Message, fields: Fields, shape: Sequence[Point]) -> Message:
    values = fields | {"speed": float(len(shape))}
    if "mode" in values:
        values["mode"] = ["IDLE", "AUTO"].index(values["mode"])
    if values.get("items") == "each":
        values["items"] = [{"id": int(max(-9.0, min(9.0, x))), "x": x, "y": y} for x, y, _ in shape]
    return filled(made, values)


def expected_beside(made: Message, beside: Fields, number: int) -> Message:
    """`number` is that of the message, from 1."""
    now = NOW + (number - 1) * 10**9
    changing: Mapping[str, Any] = {"sequence": number, "now": now / 1e9, "now * 1000": now / 1e6}
    values = {
        name: changing.get(value, value) if name != "label" else value
        for name, value in beside.items()
        if name != "header"
    }
    if "header" in beside:
        values["header"] = {}
        if "seq" in beside["header"]:
            values["header"]["seq"] = changing.get(beside["header"]["seq"], beside["header"]["seq"])
        if "sent_at" in beside["header"]:
            values["header"]["sent_at"] = dict(zip(("seconds", "nanos"), divmod(now, 10**9), strict=True))
    return filled(made, values)


@settings(max_examples=30, deadline=None, phases=[Phase.reuse, Phase.generate])  # each example compiles a table
@given(st.sampled_from([*KINDS]), MAPPINGS, SETS, st.lists(points, min_size=1, max_size=3))
def test_what_leaves_is_what_protobuf_parses(
    envelope: str, fields: Fields, beside: Fields, shapes: Sequence[Sequence[Point]]
) -> None:
    if "case: frame" in envelope:
        beside = {}  # nothing is beside the payload
    with tempfile.TemporaryDirectory() as folder:
        program = program_of(Path(folder), envelope, fields, beside)
        around = program.envelopes.first
        sent = left(program, shapes)
    assert len(sent) == len(shapes)
    for number, (data, shape) in enumerate(zip(sent, shapes, strict=True), 1):
        frame = around.message_class.FromString(data)
        [(case, payload)] = around.payloads_of(frame)
        assert case.name == KINDS[envelope]
        assert payload == expected_payload(case.message_class(), fields, shape)
        outside: Any = around.beside_of(frame)
        expected: Any = expected_beside(around.message_class(), beside, number)
        if str(beside.get("sent", "")).startswith("now"):  # a double, computed in another order
            assert outside.sent == pytest.approx(expected.sent, rel=1e-15)
            outside.sent = expected.sent
        assert outside == expected

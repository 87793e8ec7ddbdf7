"""Which kind of value fills which type of field, and what a finding calls it when it does not."""

from __future__ import annotations

import pytest

from router.errors import Code
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.compiling import field_map, findings_of, scope_of

MODE = Enum("Mode", (("OFF", 0), ("ON", 1), ("LOUD", 300)))
OTHER = Enum("Other", (("NONE", 0),))
CLOSED = Enum("Closed", (("LOW", 1), ("HIGH", 2)), is_closed=True)
ONE = MessageType("One", (Field("value", Int(32, True)),))
POINT = MessageType("Point", (Field("x", Float(32)), Field("y", Float(32))))
ENTRY = MessageType("Entry", (Field("key", String()), Field("value", Int(32, True))), is_map_entry=True)
SOURCE = MessageType(
    "Source",
    fields=(
        Field("i8", Int(8, True)), Field("u8", Int(8, False)), Field("i32", Int(32, True)), Field("i64", Int(64, True)),
        Field("f32", Float(32)), Field("f64", Float(64)), Field("flag", Bool()), Field("text", String()),
        Field("data", Bytes()), Field("mode", MODE), Field("other", OTHER), Field("one", ONE), Field("point", POINT),
        Field("ints", List(Int(32, True))), Field("bytes", List(Int(8, False))), Field("three", List(Float(32), 3)),
        Field("points", List(POINT)), Field("counts", List(ENTRY)), Field("wide", String(wide=True)),
        Field("corner", POINT, is_group=True),
    ),
)  # fmt: skip
TIME = MessageType("builtin_interfaces/msg/Time", (Field("sec", Int(32, True)), Field("nanosec", Int(32, False))))
DURATION = MessageType("builtin_interfaces/msg/Duration", TIME.fields)
ROS_POINT = MessageType("m/msg/Point", (Field("x", Float(64)), Field("z", Float(64))))
ROS_ENTRY = MessageType("m/msg/Entry", (Field("key", String()), Field("value", Int(32, True))))
ROS_ONE = MessageType("m/msg/One", (Field("data", Int(8, False)),))
UNRELATED = MessageType("m/msg/Unrelated", (Field("p", Bool()), Field("q", Bool())))

OK, MISMATCH, LOSSY, RANGE = None, Code.TYPE_MISMATCH, Code.LOSSY_CONVERSION, Code.OUT_OF_RANGE
FORBIDDEN = Code.FORBIDDEN_EXPRESSION
RULES: list[tuple[str, Type, Code | None]] = [
    ("flag", Bool(), OK),
    ("u8 != 0", Bool(), OK),
    ("u8", Bool(), MISMATCH),
    ("f32", Bool(), MISMATCH),
    ("text", Bool(), MISMATCH),
    ("mode", Bool(), MISMATCH),
    ("1", Bool(), MISMATCH),
    ("i8", Int(8, True), OK),
    ("i8", Int(64, True), OK),
    ("u8", Int(16, True), OK),
    ("255", Int(8, False), OK),
    ("i8", Int(8, False), LOSSY),
    ("i32", Int(8, False), LOSSY),
    ("256", Int(8, False), RANGE),
    ("-1", Int(64, False), RANGE),
    ("u8 + 1", Int(8, False), LOSSY),
    ("u8 - 256", Int(8, False), RANGE),
    ("clamp(i32)", Int(8, False), OK),
    ("wrap(i64)", Int(16, True), OK),
    ("clamp(i32, 0, 300)", Int(8, False), LOSSY),
    ("f32", Int(32, True), LOSSY),
    ("round(f32)", Int(8, False), OK),
    ("1.0", Int(8, False), LOSSY),
    ("flag", Int(8, False), MISMATCH),
    ("int(flag)", Int(8, False), OK),
    ("text", Int(8, False), MISMATCH),
    ("mode", Int(8, False), OK),
    ("mode", Int(32, True), OK),
    ("Mode.LOUD", Int(8, False), OK),
    ("-mode", Int(8, True), LOSSY),
    ("received_at", Int(64, True), MISMATCH),
    ("data", Int(8, False), MISMATCH),
    ("f32", Float(32), OK),
    ("f32", Float(64), OK),
    ("f64", Float(64), OK),
    ("f64", Float(32), LOSSY),
    ("float32(f64)", Float(32), OK),
    ("f32 * 0.1", Float(32), OK),
    ("f32 * f64", Float(32), LOSSY),
    ("i8", Float(32), OK),
    ("i32", Float(32), LOSSY),
    ("i32", Float(64), OK),
    ("i64", Float(64), LOSSY),
    ("float64(i64)", Float(64), OK),
    ("16777216", Float(32), OK),
    ("16777217", Float(32), LOSSY),
    ("1e39", Float(32), RANGE),
    ("-1e39", Float(32), RANGE),
    ("3.4028235677973366e38", Float(32), RANGE),
    ("3.4028235677973362e38", Float(32), OK),
    ("1e39", Float(64), OK),
    ("flag", Float(32), MISMATCH),
    ("mode", Float(32), MISMATCH),
    ("received_at", Float(64), MISMATCH),
    ("seconds(received_at)", Float(64), OK),
    ("text", String(), OK),
    ("'abc'", String(3), OK),
    ("'abcd'", String(3), RANGE),
    ("'äöü'", String(5), RANGE),
    ("'äöü'", String(3, wide=True), FORBIDDEN),
    ("text", String(wide=True), FORBIDDEN),
    ("text", String(3), OK),
    ("u8", String(), MISMATCH),
    ("str(u8)", String(), OK),
    ("data", String(), MISMATCH),
    ("'a\\0b'", String(), RANGE),
    ("'\\ud800'", String(), RANGE),
    ("received_at", TIME, OK),
    ("time_from_seconds(f64)", TIME, OK),
    ("u8", TIME, MISMATCH),
    ("text", TIME, MISMATCH),
    ("i32", ROS_ONE, LOSSY),
    ("u8", ROS_ONE, OK),
    ("mode", ROS_ONE, OK),
    ("one", Int(32, True), OK),
    ("one", Int(16, True), LOSSY),
    ("point", Float(32), MISMATCH),
    ("point", ROS_POINT, OK),
    ("point", UNRELATED, MISMATCH),
    ("u8", UNRELATED, MISMATCH),
    ("message", ROS_POINT, MISMATCH),
    ("ints", List(Int(32, True)), OK),
    ("ints", List(Int(8, True)), LOSSY),
    ("ints", List(Int(32, True), 3), OK),
    ("ints", List(Float(64)), OK),
    ("ints", List(Float(32)), LOSSY),
    ("three", List(Float(64), 3), OK),
    ("three", List(Float(64), 4), MISMATCH),
    ("three", List(Float(64), bound=2), RANGE),
    ("[1, 2, 3]", List(Int(8, False), 3), OK),
    ("[1, 2]", List(Int(8, False), 3), MISMATCH),
    ("[1, 300]", List(Int(8, False)), RANGE),
    ("[]", List(Int(8, False)), OK),
    ("[]", List(Int(8, False), 1), MISMATCH),
    ("[1, 2, 3]", List(Int(8, False), bound=2), RANGE),
    ("data", List(Int(8, False)), OK),
    ("data", List(Int(8, True)), LOSSY),
    ("u8", List(Int(8, False)), MISMATCH),
    ("text", List(Int(8, False)), MISMATCH),
    ("points", List(ROS_POINT), OK),
    ("points", List(UNRELATED), MISMATCH),
    ("points", List(Float(32)), MISMATCH),
    ("ints", Int(32, True), MISMATCH),
    ("[point, point]", List(ROS_POINT, 2), OK),
    ("[[1]]", List(Int(8, False)), MISMATCH),
    ("ints / 100", List(Float(32)), OK),
    ("ints / f64", List(Float(32)), LOSSY),
    ("ints // 100", List(Int(32, True)), OK),
    ("ints * 2", List(Int(32, True)), LOSSY),
    ("clamp(ints * 2)", List(Int(32, True)), OK),
    ("round(three)", List(Int(8, True)), OK),
    ("three * 2", List(Float(32), 3), OK),
    ("three * 2", List(Float(32), 4), MISMATCH),
    ("three + ints", List(Float(32), 3), OK),
    ("[1, 2, 3] * three", List(Float(32), 3), OK),
    ("[1, 2] * 200", List(Int(8, False)), RANGE),
    ("data + 1", List(Int(16, False)), OK),
    ("data % 16", Bytes(), OK),
    ("ints % 256", Bytes(), OK),
    ("ints", Bytes(), MISMATCH),
    ("text(ints, 1)", List(String()), OK),
    ("ints + 1", Int(32, True), MISMATCH),
    ("sum(ints)", Int(64, True), OK),
    ("sum(ints)", Int(32, True), LOSSY),
    ("sum(three)", Float(32), OK),
    ("max(ints)", Int(32, True), OK),
    ("round(f64)", Int(8, True), OK),
    ("2 * round(f64) + 1", Int(8, True), OK),
    ("round(clamp(f64, -100, 100))", Int(8, True), OK),
    ("round(clamp(f64, 200, 300))", Int(8, True), RANGE),
    ("clamp(round(f64), 0, 200)", Int(8, True), LOSSY),
    ("u8 if flag else round(f64)", Int(8, True), OK),
    ("1", CLOSED, OK),
    ("3", CLOSED, Code.UNKNOWN_ENUM_VALUE),
    ("i32", CLOSED, OK),
    ("i64", CLOSED, LOSSY),
    ("text", CLOSED, OK),
    ("counts", List(ROS_ENTRY), FORBIDDEN),
    ("wide", String(), FORBIDDEN),
    ("corner.x", Float(32), FORBIDDEN),
    ("corner", ROS_POINT, FORBIDDEN),
]


def test_value_fills_field_or_is_refused() -> None:
    for text, target, code in RULES:
        declared = MessageType("m/msg/It", (Field("it", target),))
        found = findings_of(field_map(it=text), declared, scope_of(SOURCE, [MODE, OTHER]))
        assert [finding.code for finding in found] == ([] if code is None else [code]), f"{text} to {target}"


@pytest.mark.parametrize("name", ["counts", "wide", "corner"])
def test_auto_does_not_copy_what_expressions_do_not_read(name: str) -> None:
    types: dict[str, Type] = {"counts": List(ROS_ENTRY), "wide": String(), "corner": ROS_POINT}
    declared = MessageType("m/msg/It", (Field("i8", Int(8, True)), Field(name, types[name])))
    (finding,) = findings_of(field_map(True), declared, scope_of(SOURCE))
    assert finding.code is FORBIDDEN
    assert finding.hint.startswith("map the other fields by hand")


def test_auto_does_not_copy_from_a_group_beside_a_field_that_is_given() -> None:
    declared = MessageType("m/msg/It", (Field("corner", ROS_POINT),))
    found = findings_of(field_map(True, corner__z="1"), declared, scope_of(SOURCE))
    assert [finding.code for finding in found] == [FORBIDDEN]


def test_a_time_and_a_duration_are_told_apart() -> None:
    lapse = MessageType("google.protobuf.Duration", (Field("seconds", Int(64, True)), Field("nanos", Int(32, True))))
    source = MessageType("Source", (Field("lapse", lapse), Field("point", POINT)))
    declared = MessageType("m/msg/It", (Field("it", TIME),))
    hints = [findings_of(field_map(it=text), declared, scope_of(source))[0].hint for text in ("lapse", "point")]
    assert hints == ["one is a point in time, the other a duration", "they have no field name in common"]


def test_refusal_says_what_to_do() -> None:
    declared = MessageType("m/msg/It", (Field("it", Int(8, False)),))
    hints = {
        "i32": "clamp() or wrap()",
        "f32": "round() or trunc()",
        "flag": "int()",
        "received_at": "seconds(",
    }
    for text, hint in hints.items():
        (finding,) = findings_of(field_map(it=text), declared, scope_of(SOURCE))
        assert hint in finding.hint


def moment(name: str) -> MessageType:
    return MessageType(f"google.protobuf.{name}", (Field("seconds", Int(64, True)), Field("nanos", Int(32, True))))


@pytest.mark.parametrize(("made", "declared"), [("Timestamp", DURATION), ("Duration", TIME)])
def test_a_point_in_time_is_no_duration(made: str, declared: MessageType) -> None:
    source = MessageType("Stamped", (Field("x", moment(made)),))
    (finding,) = findings_of(field_map(it="x"), MessageType("m/msg/It", (Field("it", declared),)), scope_of(source))
    assert finding.code is Code.TYPE_MISMATCH


@pytest.mark.parametrize(
    ("entries", "codes"),
    [
        ({"x": "1", "y": "2"}, [Code.UNKNOWN_FIELD]),
        ({"x__deep": "1"}, [Code.UNKNOWN_FIELD]),
        ({"nothing": "1", "missing": "2"}, [Code.UNKNOWN_FIELD, Code.UNKNOWN_FIELD]),
        ({}, [Code.NOTHING_MAPPED]),
        ({"x": "nothing", "z": "text"}, [Code.UNKNOWN_FIELD, Code.TYPE_MISMATCH]),
    ],
)
def test_every_wrong_entry_is_reported(entries: dict[str, str], codes: list[Code]) -> None:
    found = findings_of(field_map(**entries), ROS_POINT, scope_of(SOURCE))
    assert [finding.code for finding in found] == codes


def test_field_filled_twice_is_reported_whichever_way_round() -> None:
    inner = MessageType("m/msg/Outer", (Field("inner", ROS_POINT),))
    for entries in ({"inner": "point", "inner__x": "1"}, {"inner__x": "1", "inner": "point"}):
        (finding,) = findings_of(field_map(**entries), inner, scope_of(SOURCE))
        assert finding.code is Code.DUPLICATE_FIELD


def test_auto_without_a_common_name_is_reported() -> None:
    (finding,) = findings_of(field_map(True), UNRELATED, scope_of(SOURCE))
    assert finding.code is Code.NOTHING_MAPPED


def test_auto_says_which_field_it_cannot_fill() -> None:
    target = MessageType("m/msg/It", (Field("f64", Float(32)), Field("flag", Bool())))
    (finding,) = findings_of(field_map(True), target, scope_of(SOURCE))
    assert finding.code is Code.LOSSY_CONVERSION
    assert "f64" in finding.message


def test_message_without_fields_needs_no_mapping() -> None:
    empty = MessageType("std_msgs/msg/Empty")
    assert findings_of(field_map(), empty, scope_of(SOURCE)) == []

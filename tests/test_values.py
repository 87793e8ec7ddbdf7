"""Command-line words set fields, and fields are printed as such words."""

from __future__ import annotations

import json
import math
import struct
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Inertia, Point, Point32, Polygon, Vector3
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Imu, LaserScan
from std_msgs.msg import Byte, ByteMultiArray, Empty, Header, String

from router.datagrams import wire_of_protos
from router.errors import UsageError
from router.types.protobuf import PayloadCase
from router.values import (
    clock_text,
    compact,
    float_text,
    protobuf_json,
    protobuf_tree,
    rate_text,
    ros_json,
    ros_tree,
    set_fields,
    shortened,
    words,
)
from tests import everything

PROTOS = Path(__file__).parent / "protos"


@pytest.fixture(scope="module")
def every_kind() -> PayloadCase:
    return wire_of_protos(PROTOS).case("every_kind")


def build(case: PayloadCase, *words: str) -> Any:
    message = case.message_class()
    set_fields(message, case.type, words)
    return message


@pytest.mark.parametrize(
    ("word", "field", "value"),
    [
        ("flag=true", "flag", True),
        ("flag=OFF", "flag", False),
        ("i32=-5", "i32", -5),
        ("i32=0x10", "i32", 16),
        ("i64=-0x8000000000000000", "i64", -(2**63)),
        ("u64=18446744073709551615", "u64", 2**64 - 1),
        ("single=1.5", "single", 1.5),
        ("single=-inf", "single", -math.inf),
        ("single=3.4028235e+38", "single", 3.4028234663852886e38),
        ("real=1e300", "real", 1e300),
        ("text=a b=c", "text", "a b=c"),
        ("blob=0a1B", "blob", b"\x0a\x1b"),
        ("blob=", "blob", b""),
        ("mode=MODE_HALF", "mode", -2),
        ("mode=Mode.MODE_ON", "mode", 1),
        ("mode=77", "mode", 77),
        ("state=BUSY", "state", 1),
        ("state=State.BUSY", "state", 1),
        ("state=EveryKind.State.BUSY", "state", 1),
    ],
)
def test_a_word_sets_its_field(every_kind: PayloadCase, word: str, field: str, value: object) -> None:
    assert getattr(build(every_kind, word), field) == value


def test_nested_fields_are_reached_by_dots_and_make_the_message_present(every_kind: PayloadCase) -> None:
    message = build(every_kind, "point.x=3", "point.y=0")
    assert (message.point.x, message.HasField("point")) == (3, True)
    assert build(every_kind, "point=").HasField("point")


def test_lists_are_appended_to_or_set_by_index_and_later_words_win(every_kind: PayloadCase) -> None:
    assert list(build(every_kind, "numbers=1", "numbers=2.5").numbers) == [1, 2.5]
    message = build(every_kind, "numbers[2]=7", "numbers[0]=1", "modes[1]=MODE_ON", "points[1].y=4", "i32=1", "i32=2")
    assert list(message.numbers) == [1, 0, 7]
    assert list(message.modes) == [0, 1]
    assert [point.y for point in message.points] == [0, 4]
    assert message.i32 == 2
    assert math.isnan(build(every_kind, "single=nan").single)


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("flagg=1", "EveryKind has no field 'flagg'; did you mean 'flag'?"),
        ("point.z=1", "Point has no field 'z'; known: x, y"),
        ("flag", "'flag' is not an assignment; write flag=value"),
        ("flag=perhaps", "flag: 'perhaps' is not a bool; write true or false"),
        ("i32=1.5", "i32: '1.5' is not an integer (int32); write it as 42, -1 or 0x2a"),
        ("i32=2147483648", "i32: 2147483648 does not fit int32, which holds -2147483648 to 2147483647"),
        ("u32=-1", "u32: -1 does not fit uint32, which holds 0 to 4294967295"),
        ("single=fast", "single: 'fast' is not a number (float32); write it as 1.5, -2e3, nan or inf"),
        ("single=1e39", "single: 1e39 does not fit float32, which holds -3.4028235e+38 to 3.4028235e+38"),
        (
            "real=1e999",
            "real: 1e999 does not fit float64, which holds -1.7976931348623157e+308 to 1.7976931348623157e+308",
        ),
        ("mode=MODE_OM", "mode: Mode has no value 'MODE_OM'; did you mean 'MODE_ON'?"),
        ("mode=99999999999", "mode: 99999999999 does not fit int32, which holds -2147483648 to 2147483647"),
        ("blob=xyz", "blob: 'xyz' is not hex; write bytes as 0a1b2c"),
        ("point=3", "point is the message Point; set its fields, such as point.x=..."),
        ("flag.x=1", "flag of EveryKind is bool, which has no fields"),
        ("flag[0]=1", "flag[0]: flag is bool, not a list"),
        (
            "numbers=[1,2]",
            (
                "numbers is a list, float32[], and '[1,2]' is no element of it; "
                "write each element: numbers[0]=... numbers[1]=..."
            ),
        ),
        (
            "points=3",
            (
                "points is a list, Point[], and '3' is no element of it; "
                "write each element: points[0].x=... points[1].x=..."
            ),
        ),
        ("points.x=1", "points.x: points is a list; name an element, such as points[0].x=..."),
        ("numbers[99999]=1", "numbers[99999]: float32[] holds at most 65507 elements"),
        (
            "a b=1",
            "'a b' is not a field path; write it as x, bbox.x, points[0] or counts[key]: elements count from 0",
        ),
    ],
)
def test_a_wrong_word_is_explained_in_one_line(every_kind: PayloadCase, word: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        build(every_kind, word)
    assert str(caught.value) == complaint


POINTS = st.builds(lambda x, y: {"x": x, "y": y}, st.integers(-(2**31), 2**31 - 1), st.integers(-5, 5))
MESSAGES = st.fixed_dictionaries(
    {},
    optional={
        "flag": st.booleans(),
        "i64": st.integers(-(2**63), 2**63 - 1),
        "u64": st.integers(0, 2**64 - 1),
        "single": st.floats(width=32, allow_nan=False),
        "real": st.floats(allow_nan=False),
        "text": st.text(),
        "blob": st.binary(),
        "mode": st.integers(-(2**31), 2**31 - 1),
        "point": POINTS,
        "numbers": st.lists(st.floats(width=32, allow_nan=False), max_size=5),
        "points": st.lists(POINTS, max_size=3),
        "maybe": st.integers(-1, 1),
    },
)


@given(values=MESSAGES)
def test_what_is_shown_can_be_sent_again(every_kind: PayloadCase, values: dict[str, Any]) -> None:
    message = every_kind.message_class(**values)
    again = every_kind.message_class()
    set_fields(again, every_kind.type, list(words(protobuf_tree(message, every_kind.type))))
    assert again.SerializeToString() == message.SerializeToString()


@pytest.mark.parametrize("case", everything.wire().envelope.cases)
def test_every_feature_of_protobuf_is_shown_so_that_it_can_be_sent_again(case: str) -> None:
    message, kind = everything.payload(case), everything.wire().case(case).type
    again = type(message)()
    set_fields(again, kind, [word for word in words(protobuf_tree(message, kind)) if word != "="])
    assert again == message


PLAIN, OLD = (everything.wire().case(name) for name in ("plain", "old"))


def test_a_map_is_set_by_its_keys() -> None:
    keys = {"left": "1", "a.b": "2", 'x"]=[': "3", "": "4", "zażółć": "5"}
    message = build(PLAIN, *(f"by_text[{json.dumps(key)}]={value}" for key, value in keys.items()), "by_text[left]=9")
    assert dict(message.by_text) == {**keys, "left": "9"}
    message = build(PLAIN, "by_i32[-5].speed=2", "by_i32[0x7]=", "by_flag[yes].speed=1")
    assert {key: value.speed for key, value in message.by_i32.items()} == {-5: 2, 7: 0}
    assert message.by_flag[True].speed == 1
    assert compact(message, PLAIN.type) == "by_i32[-5].speed=2 by_i32[7]= by_flag[true].speed=1"


@pytest.mark.parametrize(
    ("case", "word", "complaint"),
    [
        (PLAIN, "by_text=x", "by_text is a map; name a value, such as by_text[key]=..."),
        (PLAIN, "by_text.left=x", "by_text is a map; name a value, such as by_text[left]=..."),
        (PLAIN, "by_i32.speed=1", "by_i32.speed: by_i32 is a map; name an element, such as by_i32[key].speed=..."),
        (PLAIN, "by_i32[left]=", "by_i32[left]: 'left' is not an integer (int32); write it as 42, -1 or 0x2a"),
        (PLAIN, 'by_text["\\q"]=1', """by_text["\\q"]: "\\q" is not a key: Invalid \\escape; quote it as in JSON"""),
        (PLAIN, "singles[left]=1", "singles[left]: 'left' is not an index; elements are numbered from 0"),
        (OLD, "closed=0", "closed: old.Closed has no value '0'; known: CLOSED_LESS, CLOSED_ONE, CLOSED_TWO"),
    ],
)
def test_a_wrong_word_for_a_map_or_a_closed_enum_is_explained(case: PayloadCase, word: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        build(case, word)
    assert str(caught.value) == complaint


def test_a_list_of_a_closed_enum_is_extended_with_its_first_value() -> None:
    assert list(build(OLD, "some[1]=CLOSED_TWO").some) == [1, 2]


@pytest.mark.parametrize(
    ("case", "fields", "expected"),
    [
        (
            "known",
            {"at": {"seconds": 10**12, "nanos": 5}, "lasts": {"seconds": 1}, "whole": {"value": 2**60}},
            {"at": {"seconds": str(10**12), "nanos": 5}, "lasts": "1s", "whole": str(2**60)},
        ),
        ("known", {"lasts": {"seconds": 1, "nanos": -1}}, {"lasts": {"seconds": "1", "nanos": -1}}),
        ("any", {"type_url": "t/no.Such", "value": b"\xff"}, {"type_url": "t/no.Such", "value": "/w=="}),
        (
            "any",
            {"type_url": "t/plain.Motor", "value": b"\x0d\0\0\x80\x3f"},
            {"@type": "t/plain.Motor", "speed": 1.0},
        ),
        (
            "object",
            {"fields": {"a": {"number_value": math.nan}, "b": {"bool_value": True}}},
            {"fields": {"a": {"number_value": "NaN"}, "b": True}},
        ),
        ("at", {"seconds": 0}, "1970-01-01T00:00:00Z"),
    ],
)
def test_only_what_has_no_json_form_is_shown_by_its_fields(case: str, fields: dict[str, Any], expected: Any) -> None:
    assert protobuf_json(everything.payload(case, **fields)) == expected


@pytest.mark.parametrize("datagram", everything.odd().values(), ids=everything.odd())
def test_every_payload_has_a_json_form(datagram: bytes) -> None:
    message = everything.wire().decode(datagram).message
    for complete in (False, True):
        assert json.loads(json.dumps(protobuf_json(message, complete=complete), allow_nan=False)) is not ...


def test_defaults_are_left_out(every_kind: PayloadCase) -> None:
    message = every_kind.message_class(flag=True, i32=0, mode=1, state=9, point={"x": 1}, numbers=[0.5, 0])
    line = compact(message, every_kind.type)
    assert line == "flag=true mode=MODE_ON state=9 point.x=1 numbers[0]=0.5 numbers[1]=0"
    assert compact(every_kind.message_class(), every_kind.type) == "(all default)"


def test_a_text_of_several_lines_stays_one_line(every_kind: PayloadCase) -> None:
    assert compact(every_kind.message_class(text="a\nb"), every_kind.type) == "'text=a\\nb'"


@given(st.floats(width=32, allow_nan=False))
def test_a_float_is_written_so_that_it_reads_back(value: float) -> None:
    assert struct.pack("<f", float(float_text(value, 32))) == struct.pack("<f", value)


@pytest.mark.parametrize(("rate", "text"), [(0, "0"), (0.51, "0.5"), (9.97, "10"), (49.7, "50"), (1234.5, "1234")])
def test_rates_are_short(rate: float, text: str) -> None:
    assert rate_text(rate) == text


def test_rounding_leaves_a_double_twice_the_digits() -> None:
    assert (float_text(51.099312345, 32, digits=4), float_text(51.099312345, 64, digits=4)) == ("51.1", "51.099312")
    assert float_text(float("nan"), 32, digits=4) == "nan"


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (Empty(), []),
        (Point(), []),
        (Point(x=-0.0, y=0.1), ["y=0.1"]),
        (Point32(x=0.1), ["x=0.1"]),
        (Byte(data=b"\x07"), ["data=7"]),
        (ByteMultiArray(data=[b"\x00", b"\x07"]), ["data=[0,7]"]),
        (Header(frame_id="map"), ["frame_id=map"]),
        (Inertia(com=Vector3(x=1.0)), ["com.x=1.0"]),
        (Polygon(points=[Point32(x=1.0), Point32(y=math.inf)]), ["points[0].x=1", "points[1].y=inf"]),
        (LaserScan(ranges=[1.0, 0.1]), ["ranges=[1,0.1]"]),
    ],
)
def test_what_is_not_zero_is_shown_by_its_path(message: Any, expected: list[str]) -> None:
    assert list(words(ros_tree(message))) == expected


def test_long_arrays_are_cut() -> None:
    scan = LaserScan(ranges=[1.0] * 360)
    assert list(words(ros_tree(scan))) == ["ranges=[1,1,1,1,1,1,1,1,...](360)"]
    many = Polygon(points=[Point32(x=float(n)) for n in range(1, 12)])
    assert list(words(ros_tree(many)))[-2:] == ["points[7].x=8", "points=...(11)"]


def test_json_has_every_field() -> None:
    imu = Imu(header=Header(frame_id="imu"))
    imu.angular_velocity.x = math.nan
    said = json.loads(json.dumps(ros_json(imu), allow_nan=False))
    assert said["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "imu"}
    assert said["angular_velocity"] == {"x": "NaN", "y": 0.0, "z": 0.0}
    assert said["linear_acceleration_covariance"] == [0.0] * 9


def test_json_has_numbers_for_octets_and_words_for_infinities() -> None:
    assert ros_json(ByteMultiArray(data=[b"\x07"]))["data"] == [7]
    assert ros_json(Point(x=math.inf, y=-math.inf)) == {"x": "Infinity", "y": "-Infinity", "z": 0.0}
    assert ros_json(String(data="a b")) == {"data": "a b"}


def test_a_long_name_keeps_its_beginning_and_end() -> None:
    assert shortened("sensor_board_diagnostics", 18) == "sensor_bo…gnostics"
    assert shortened("imu_data", 18) == "imu_data"


def test_a_time_of_day_has_its_offset_from_utc() -> None:
    at = datetime(2026, 4, 12, 10, 15, 0, 123456, timezone(timedelta(hours=5, minutes=30)))
    assert clock_text(at) == "10:15:00.123+0530"

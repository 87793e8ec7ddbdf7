"""Messages and values as words, as JSON and as short texts."""

from __future__ import annotations

import json
import math
import struct
from datetime import datetime, timedelta, timezone
from typing import Any

import pytest
from geometry_msgs.msg import Inertia, Point, Point32, Polygon, Vector3
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Imu, LaserScan
from std_msgs.msg import Byte, ByteMultiArray, Empty, Header, String

from router.types.protobuf import PayloadCase
from router.values.printing import (
    clock_text,
    compact,
    float_text,
    protobuf_json,
    rate_text,
    ros_json,
    ros_tree,
    shortened,
    words,
)
from tests import everything


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


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (Empty(), []),
        (Header(), ["stamp.sec=0", "stamp.nanosec=0", "frame_id="]),
        (Byte(), ["data=0"]),
        (ByteMultiArray(), ["layout.dim=[]", "layout.data_offset=0", "data=[]"]),
        (Polygon(points=[Point32(x=1.0)]), ["points[0].x=1", "points[0].y=0", "points[0].z=0"]),
    ],
)
def test_all_fields_are_shown_if_asked(message: Any, expected: list[str]) -> None:
    assert list(words(ros_tree(message, complete=True))) == expected


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

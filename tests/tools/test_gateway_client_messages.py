from __future__ import annotations

import datetime as dt
import json
from typing import Any

import pytest

from router.gateway.documents import data_document, rejected_document, schema_document
from router.gateway.packets import Packet, PacketError, compress, pack
from router.tools.gateway_client import Message, Problem, Received, Remark, Schema, Shape, json_line, pieces, read

HEADER = {
    "name": "Header",
    "namespace": "std_msgs::msg",
    "fields": [{"name": "frame_id", "is_array": False, "type": "string", "subtype": "primitive"}],
}
SCHEMA = {
    "name": "Imu",
    "namespace": "sensor_msgs::msg",
    "fields": [
        {"name": "header", "is_array": False, "type": "message", "subtype": HEADER},
        {"name": "covariance", "is_array": True, "type": "float64", "subtype": "primitive"},
    ],
}
SHAPE = {
    "header": Shape("Header", False, {"frame_id": Shape("string", False, {})}),
    "covariance": Shape("float64", True, {}),
}


def packet(payload: bytes, is_compressed: bool = False) -> bytes:
    return pack(Packet(5.0, is_compressed, "/imu", "sensor_msgs/msg/Imu", payload))


def test_a_packet_holds_a_message_compressed_or_not_or_with_all_keys_of_one_a_schema() -> None:
    message = Message(5.0, "/imu", "sensor_msgs/msg/Imu", {"x": [0.01]}, is_wrapped=True)
    assert read(packet(b'{"x":[0.01]}')) == message
    assert read(packet(compress(b'{"x":[0.01]}', 3), is_compressed=True)) == message
    assert read(packet(json.dumps(SCHEMA).encode())) == Schema(5.0, "/imu", "sensor_msgs/msg/Imu", SCHEMA, SHAPE)
    data = {"name": ["n"], "namespace": ["ns"], "fields": [[]]}
    assert read(packet(json.dumps(data).encode())) == message._replace(data=data)


def test_documents_say_what_they_are() -> None:
    assert read(data_document("/imu", "p/msg/T", 5.0, b'{"x":0.01}')) == Message(
        5.0, "/imu", "p/msg/T", {"x": 0.01}, False
    )
    assert read(schema_document("p/msg/T", 5.0, json.dumps(SCHEMA))) == Schema(5.0, "", "p/msg/T", SCHEMA, SHAPE)
    refusal = {"op": "rejected", "reason": "invalid", "detail": "no x", "topic": "/imu"}
    assert read(rejected_document("invalid", "no x", "/imu")) == Remark(refusal)


def test_a_packet_whose_time_begins_like_a_document_is_a_packet() -> None:
    data = b'{"op":"d' + packet(b"{}")[8:]
    assert read(data).__class__ is Message


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "too short for a packet"),
        (packet(b""), "not JSON"),
        (packet(b"[]"), "JSON that is not an object"),
        (packet(b'{"x":\xff}'), "not JSON: .*decode"),
        (packet(b"{}", is_compressed=True), "not a zstd frame"),
        (packet(b'{"x":' + b"[" * 100 + b"]" * 100 + b"}"), "more than 64 levels"),
        (packet(b'{"x":' + b"[" * 100_000 + b"]" * 100_000 + b"}"), "not JSON"),
        (packet(b'{"name":"T","namespace":"p","fields":[{"name":"x"}]}'), "not a schema: KeyError"),
        (packet(b'{"name":"T","namespace":"p","fields":3}'), "not a schema: TypeError"),
        (packet(b'{"name":"T","namespace":"p","fields":[{"name":[],"type":"bool","is_array":0}]}'), "not a schema"),
        (b'{"op":"schema","type":"t","time":1}', "not a schema"),
        (b'{"op":"data","topic":"/t","type":"t","data":{}}', "without time or type"),
        (b'{"op":"data","topic":"/t","type":"t","time":1,"data":[]}', "without topic or data"),
        (b'{"op":"data"', "not JSON"),
        (b"{", "not JSON"),
        (b'{"x":1,  "y":2}', "of unknown kind"),
    ],
)
def test_what_means_nothing_is_refused_with_the_reason(data: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        read(data)


NOON = dt.datetime(2026, 5, 1, 12, 0, 0, 123_000).timestamp()  # noqa: DTZ001 - local, as it is shown
CLOCK = f"12:00:00.123{dt.datetime.fromtimestamp(NOON).astimezone():%z}"
FIELDS = {
    "x": Shape("float32", False, {}),
    "list": Shape("float64", True, {}),
    "header": Shape("Header", False, {"frame_id": Shape("string", False, {})}),
    "points": Shape("Point", True, {"y": Shape("int32", False, {})}),
}


def line(heard: Received) -> str:
    return " ".join(text for text, _ in pieces(heard))


def message(data: dict[str, Any], is_wrapped: bool = True, shape: Any = FIELDS) -> Message:
    return Message(NOON, "/imu", "p/msg/T", data, is_wrapped, shape)


@pytest.mark.parametrize(
    ("data", "values"),
    [
        ({"x": [0.10000000149011612]}, "x=0.1"),
        ({"x": [None]}, "x=null"),
        ({"list": [0.5]}, "list=[0.5]"),
        ({"list": []}, "list=[]"),
        ({"list": list(range(1000))}, "list=[0,1,2,3,4,5,6,7,...](1000)"),
        ({"header": [{"frame_id": ["base"]}]}, "header.frame_id=base"),
        ({"header": [{"frame_id": ["base link"]}]}, "'header.frame_id=base link'"),
        ({"header": [{"frame_id": ["\x1b[31m"]}]}, r"'header.frame_id=\x1b[31m'"),
        ({"header": [{"frame_id": ["x" * 200]}]}, f"header.frame_id={'x' * 120}...(200)"),
        ({"header": [{}]}, "header="),
        ({"points": [{"y": [1]}, {"y": [2]}]}, "points[0].y=1 points[1].y=2"),
        ({"points": [{"y": [1]}] * 9}, " ".join(f"points[{n}].y=1" for n in range(8)) + " points=...(9)"),
        ({"unknown": [True]}, "unknown=[true]"),
        ({}, "(empty)"),
    ],
)
def test_single_values_stand_without_their_list_and_long_lists_are_cut(data: dict[str, Any], values: str) -> None:
    assert line(message(data)) == f"{CLOCK} /imu p/msg/T {values}"


def test_before_the_schema_and_where_nothing_is_wrapped_values_are_shown_as_received() -> None:
    early = message({"x": [1.5], "header": [{"frame_id": ["base"]}]}, shape=None)
    assert line(early).endswith(" x=[1.5] header[0].frame_id=[base]")
    data = {"x": 1.5, "list": [0.5], "header": {"frame_id": "base"}, "points": [{"y": 1}]}
    assert line(message(data, is_wrapped=False)).endswith(" x=1.5 list=[0.5] header.frame_id=base points[0].y=1")


def test_a_schema_is_shortened_to_its_fields() -> None:
    assert line(Schema(NOON, "/imu", "p/msg/T", {}, FIELDS)) == (
        f"{CLOCK} /imu p/msg/T schema x:float32 list:float64[] header:Header points:Point[]"
    )
    assert line(Schema(NOON, "", "p/msg/T", {}, {})) == f"{CLOCK} p/msg/T schema (empty)"


def test_what_else_is_heard_is_shown_too() -> None:
    refusal = {"op": "rejected", "reason": "invalid", "topic": "/imu"}
    assert line(Remark(refusal)) == "op=rejected reason=invalid topic=/imu"
    topics = {"op": "topics", "time": 5.0, "topics": [{"topic": "/a", "rate": 1.0}, {"topic": "/b", "rate": 1.0}, None]}
    assert line(Remark(topics)) == "topics 3: /a /b"
    assert line(Problem("not JSON", b"\xff\xff")) == "undecodable (not JSON): ffff"
    assert line(Problem("empty", b"")) == "undecodable (empty): no bytes"
    assert line(Problem("long", b"x" * 61)) == f"undecodable (long): {'78' * 60}...(61 bytes)"


@pytest.mark.parametrize("time", [float("nan"), 1e300, -1e18])
def test_a_time_beyond_every_calendar_is_shown_as_a_number(time: float) -> None:
    assert line(message({})._replace(time=time)).startswith(f"time={time} /imu")


def test_json_is_what_was_received() -> None:
    data = {"x": [0.10000000149011612], "s": ["\u00e9\n"]}
    said = {"time": NOON, "topic": "/imu", "type": "p/msg/T", "data": data}
    assert json.loads(json_line(message(data))) == said
    schema = {"name": "T", "namespace": "p::msg", "fields": []}
    said = {"time": NOON, "topic": "/imu", "type": "p/msg/T", "schema": schema}
    assert json.loads(json_line(Schema(NOON, "/imu", "p/msg/T", schema, {}))) == said
    assert "topic" not in json.loads(json_line(Schema(NOON, "", "p/msg/T", schema, {})))
    assert json.loads(json_line(Remark({"op": "topics"}))) == {"op": "topics"}
    assert json.loads(json_line(Problem("not JSON", b"\xff"))) == {"problem": "not JSON", "bytes": 1, "hex": "ff"}
    assert "\n" not in json_line(message(data))

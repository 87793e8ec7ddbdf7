from __future__ import annotations

import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.compression import compress
from router.gateway.documents import data_document, rejected_document, schema_document
from router.gateway.packets import Packet, PacketError, pack
from router.tools.listening_reading import Message, Remark, Schema, Shape, read

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


def test_a_packet_holds_a_message_compressed_or_not() -> None:
    message = Message(5.0, "/imu", "sensor_msgs/msg/Imu", {"x": [0.01]}, is_wrapped=True)
    assert read(packet(b'{"x":[0.01]}')) == message
    assert read(packet(compress(b'{"x":[0.01]}', 3), is_compressed=True)) == message


def test_a_packet_with_the_keys_of_a_schema_is_one() -> None:
    assert read(packet(json.dumps(SCHEMA).encode())) == Schema(5.0, "/imu", "sensor_msgs/msg/Imu", SCHEMA, SHAPE)


def test_a_message_with_fields_of_these_names_is_none() -> None:
    data = {"name": ["n"], "namespace": ["ns"], "fields": [[]]}
    assert read(packet(json.dumps(data).encode())) == Message(5.0, "/imu", "sensor_msgs/msg/Imu", data, is_wrapped=True)


def test_documents_say_what_they_are() -> None:
    assert read(data_document("/imu", "p/msg/T", 5.0, '{"x":0.01}')) == Message(
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
        (b"", "no packet"),
        (packet(b""), "no JSON"),
        (packet(b"[]"), "JSON that is no object"),
        (packet(b'{"x":\xff}'), "no JSON: .*decode"),
        (packet(b"{}", is_compressed=True), "no zstd frame"),
        (packet(b'{"x":' + b"[" * 100 + b"]" * 100 + b"}"), "more than 64 levels"),
        (packet(b'{"x":' + b"[" * 100_000 + b"]" * 100_000 + b"}"), "no JSON"),
        (packet(b'{"name":"T","namespace":"p","fields":[{"name":"x"}]}'), "no schema: KeyError"),
        (packet(b'{"name":"T","namespace":"p","fields":3}'), "no schema: TypeError"),
        (packet(b'{"name":"T","namespace":"p","fields":[{"name":[],"type":"bool","is_array":0}]}'), "no schema"),
        (b'{"op":"schema","type":"t","time":1}', "no schema"),
        (b'{"op":"data","topic":"/t","type":"t","data":{}}', "without time or type"),
        (b'{"op":"data","topic":"/t","type":"t","time":1,"data":[]}', "without topic or data"),
        (b'{"op":"data"', "no JSON"),
        (b"{", "no JSON"),
        (b'{"x":1,  "y":2}', "does not say what it is"),
    ],
)
def test_what_means_nothing_is_refused_with_the_reason(data: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        read(data)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["fields", "name", "type"]), inner),
)


@given(st.dictionaries(st.sampled_from(["op", "name", "namespace", "fields", "time", "topic", "type"]), JSON))
def test_any_json_is_read_or_refused(content: object) -> None:
    text = json.dumps(content).encode()
    for data in (text, packet(text)):
        with suppress(PacketError):
            read(data)

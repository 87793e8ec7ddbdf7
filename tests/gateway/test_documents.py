from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.documents import (
    PublishRequest,
    SchemaRequest,
    data_document,
    inbound_document,
    rejected_document,
    request,
    schema_document,
    topics_document,
)
from router.gateway.json_types import Style, schema_text
from router.gateway.packets import PacketError
from router.types.model import Field, Float, Int, MessageType, String, Type

TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
TYPE = MessageType("p/msg/T", (Field("x", Float(64)),))
SCHEMA = json.loads(schema_text(TYPE, Style.PLAIN))
TIMES = st.floats(allow_nan=False, allow_infinity=False)


@given(TEXTS, TEXTS, TIMES)
def test_data_and_schema_name_topic_type_and_time(topic: str, type_name: str, time: float) -> None:
    document = data_document(topic, type_name, time, b'{"x":0.1}')
    assert json.loads(document) == {"op": "data", "topic": topic, "type": type_name, "time": time, "data": {"x": 0.1}}
    document = schema_document(type_name, time, '{"fields":[]}')
    assert json.loads(document) == {"op": "schema", "type": type_name, "time": time, "schema": {"fields": []}}


def test_the_text_of_a_message_stands_in_its_document_as_it_is() -> None:
    document = data_document("/t", "p/msg/T", 1.5, '{"x":0.10000000149011612,"s":"\u00e9"}'.encode())
    assert document.decode() == (
        '{"op":"data","topic":"/t","type":"p/msg/T","time":1.5,"data":{"x":0.10000000149011612,"s":"\u00e9"}}'
    )


UINT8, FLOAT = Int(8, signed=False), Float(64)


@pytest.mark.parametrize(
    ("fields", "constants", "names"),
    [
        (
            {"power": UINT8, "power_status": UINT8},
            {"POWER_STATUS_FULL": 4, "POWER_ON": 1, "OTHER": 4, "POWER_NAME": "x"},
            {"power": {"1": "ON"}, "power_status": {"4": "FULL"}},
        ),
        (
            {"kind": UINT8, "range": FLOAT},
            {"ULTRASOUND": 0, "INFRARED": 1},
            {"kind": {"0": "ULTRASOUND", "1": "INFRARED"}},
        ),
        ({"kind": UINT8}, {"ON": 1, "OPEN": 1, "OFF": 0}, {"kind": {"0": "OFF"}}),
        ({"offset": UINT8, "datatype": UINT8}, {"INT8": 1, "UINT8": 2}, {}),
        ({"range": FLOAT}, {"RANGE_MOST": 1}, {}),
    ],
    ids=["prefix", "only integer", "two names", "in doubt", "no integer"],
)
def test_values_have_the_names_of_constants_where_these_are_without_doubt(
    fields: dict[str, Type], constants: dict[str, object], names: dict[str, dict[str, str]]
) -> None:
    declared = MessageType("p/msg/T", tuple(Field(name, kind) for name, kind in fields.items()), constants)
    found = json.loads(schema_text(declared, Style.PLAIN))["fields"]
    assert {each["name"]: each["names"] for each in found if "names" in each} == names
    assert '"names"' not in schema_text(declared, Style.WRAPPED)


def test_topics_inbound_and_refusals_are_documents_too() -> None:
    assert json.loads(topics_document(2.5, [("/t", "p/msg/T", 49.5)])) == {
        "op": "topics",
        "time": 2.5,
        "topics": [{"topic": "/t", "type": "p/msg/T", "rate": 49.5}],
    }
    assert json.loads(inbound_document({"/t": TYPE})) == {
        "op": "inbound",
        "topics": [
            {
                "topic": "/t",
                "type": "p/msg/T",
                "schema": json.loads(schema_text(TYPE, Style.PLAIN)),
                "example": {"x": 0.0},
            }
        ],
    }
    assert json.loads(rejected_document("invalid", "no 'x'\n", "/t")) == {
        "op": "rejected",
        "reason": "invalid",
        "detail": "no 'x'\n",
        "topic": "/t",
    }


@given(TEXTS)
def test_no_document_has_a_newline(name: str) -> None:
    documents = [
        data_document(name, name, 1.0, b"{}"),
        schema_document(name, 1.0, "{}"),
        topics_document(1.0, [(name, name, 1.0)]),
        inbound_document({name: MessageType(name, (Field(name, String(), default=name),))}),
        rejected_document("invalid", name, name),
    ]
    assert not any(b"\n" in document for document in documents)


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        (
            '{"op":"publish","topic":"/t","type":"p/msg/T","time":5,"data":{"x":1}}',
            PublishRequest("/t", "p/msg/T", 5.0, b'{"x":1}'),
        ),
        ('{"op":"publish","topic":"/t","data":null}', PublishRequest("/t", None, None, b"null")),
        ('{"op":"publish","topic":"/t","type":null,"time":null,"data":3}', PublishRequest("/t", None, None, b"3")),
        ('{"op":"schema","type":"p/msg/T"}', SchemaRequest("p/msg/T")),
        (' {"op": "schema"}\n', SchemaRequest(None)),
    ],
)
def test_what_a_client_asks_for(text: str, meaning: object) -> None:
    assert request(text.encode()) == meaning


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[]", "Expected `object`, got `array`"),
        ("{}", "missing required field `op`"),
        ('{"op":"data"}', "Invalid value 'data' - at `.\\.op`"),
        ('{"op":["publish"]}', "Expected `str` - at `.\\.op`"),
        ('{"op":"schema","topic":"/t"}', "unknown field `topic`"),
        ('{"op":"schema","type":1}', "got `int` - at `.\\.type`"),
        ('{"op":"publish","topic":"/t","tpye":"p/msg/T","data":{}}', "unknown field `tpye`"),
        ('{"op":"publish","data":{}}', "missing required field `topic`"),
        ('{"op":"publish","topic":1,"data":{}}', "Expected `str`, got `int` - at `.\\.topic`"),
        ('{"op":"publish","topic":"/t"}', "missing required field `data`"),
        ('{"op":"publish","topic":"/t","type":[],"data":{}}', "got `array` - at `.\\.type`"),
        ('{"op":"publish","topic":"/t","time":true,"data":{}}', "got `bool` - at `.\\.time`"),
        ('{"op":"publish","topic":"/t","time":1e999,"data":{}}', "Number out of range - at `.\\.time`"),
        ('{"op":"publish","topic":"/t","time":"5","data":{}}', "got `str` - at `.\\.time`"),
    ],
)
def test_what_is_no_request_is_refused_with_the_reason(text: str, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        request(text.encode())


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b'{"op":"publish","topic":"/t","data":' + b"[" * 100_000])
def test_what_is_no_json_is_refused_as_that(text: bytes) -> None:
    with pytest.raises(PacketError, match="not JSON"):
        request(text)


@given(st.binary(max_size=60))
def test_any_bytes_are_a_request_or_refused(text: bytes) -> None:
    with pytest.raises(PacketError):
        request(text)

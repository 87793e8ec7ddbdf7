from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.documents import (
    InboundRow,
    PublishRequest,
    SchemaRequest,
    TopicRow,
    data_document,
    heading,
    inbound_document,
    rejected_document,
    request,
    schema_document,
    topics_document,
)
from router.gateway.json_reading import InvalidMessageError
from router.gateway.packets import PacketError

TIMES = st.floats(allow_nan=False, allow_infinity=False)


@given(st.text(), st.text(), TIMES)
def test_data_and_schema_name_topic_type_and_time(topic: str, type_name: str, time: float) -> None:
    document = data_document(topic, type_name, time, '{"x":0.1}')
    assert json.loads(document) == {"op": "data", "topic": topic, "type": type_name, "time": time, "data": {"x": 0.1}}
    document = schema_document(type_name, time, '{"fields":[]}')
    assert json.loads(document) == {"op": "schema", "type": type_name, "time": time, "schema": {"fields": []}}


def test_the_text_of_a_message_stands_in_its_document_as_it_is() -> None:
    document = data_document("/t", "p/msg/T", 1.5, '{"x":0.10000000149011612,"s":"\u00e9"}')
    assert document.decode() == (
        '{"op":"data","topic":"/t","type":"p/msg/T","time":1.5,"data":{"x":0.10000000149011612,"s":"\u00e9"}}'
    )


def test_topics_inbound_and_refusals_are_documents_too() -> None:
    assert json.loads(topics_document(2.5, [TopicRow("/t", "p/msg/T", 49.5)])) == {
        "op": "topics",
        "time": 2.5,
        "topics": [{"topic": "/t", "type": "p/msg/T", "rate": 49.5}],
    }
    assert json.loads(inbound_document([InboundRow("/t", "p/msg/T", '{"fields":[]}', {"x": 0.0})])) == {
        "op": "inbound",
        "topics": [{"topic": "/t", "type": "p/msg/T", "schema": {"fields": []}, "example": {"x": 0.0}}],
    }
    assert json.loads(rejected_document("invalid", "no 'x'\n", "/t")) == {
        "op": "rejected",
        "reason": "invalid",
        "detail": "no 'x'\n",
        "topic": "/t",
    }


@given(st.text())
def test_no_document_has_a_newline(name: str) -> None:
    documents = [
        data_document(name, name, 1.0, "{}"),
        schema_document(name, 1.0, "{}"),
        topics_document(1.0, [TopicRow(name, name, 1.0)]),
        inbound_document([InboundRow(name, name, "{}", {"x": name})]),
        rejected_document("invalid", name, name),
    ]
    assert not any(b"\n" in document for document in documents)


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        (
            '{"op":"publish","topic":"/t","type":"p/msg/T","time":5,"data":{"x":1}}',
            PublishRequest("/t", "p/msg/T", 5.0, {"x": 1}),
        ),
        ('{"op":"publish","topic":"/t","data":null}', PublishRequest("/t", None, None, None)),
        ('{"op":"publish","topic":"/t","type":null,"time":null,"data":3}', PublishRequest("/t", None, None, 3)),
        ('{"op":"schema","type":"p/msg/T"}', SchemaRequest("p/msg/T")),
        (' {"op": "schema"}\n', SchemaRequest(None)),
    ],
)
def test_what_a_client_asks_for(text: str, meaning: object) -> None:
    assert request(text.encode()) == meaning


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[]", "a request is a JSON object"),
        ("{}", "'op' is neither publish nor schema"),
        ('{"op":"data"}', "'op' is neither publish nor schema"),
        ('{"op":["publish"]}', "'op' is neither publish nor schema"),
        ('{"op":"schema","topic":"/t"}', "a request of this kind has no 'topic'"),
        ('{"op":"schema","type":1}', "'type' is not a text"),
        ('{"op":"publish","topic":"/t","tpye":"p/msg/T","data":{}}', "a request of this kind has no 'tpye'"),
        ('{"op":"publish","data":{}}', "'topic' is not a text"),
        ('{"op":"publish","topic":1,"data":{}}', "'topic' is not a text"),
        ('{"op":"publish","topic":"/t"}', "there is no 'data'"),
        ('{"op":"publish","topic":"/t","type":[],"data":{}}', "'type' is not a text"),
        ('{"op":"publish","topic":"/t","time":true,"data":{}}', "'time' is not a number"),
        ('{"op":"publish","topic":"/t","time":"5","data":{}}', "'time' is not a number"),
    ],
)
def test_what_is_no_request_is_refused_with_the_reason(text: str, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        request(text.encode())


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b'{"op":"publish","topic":"/t","time":1e999,"data":{}}'])
def test_what_is_no_json_is_refused_as_that(text: bytes) -> None:
    with pytest.raises(InvalidMessageError):
        request(text)


DATA = '"data":{"a":[' + "1," * 1000 + '{"topic":"/no","type":"no"}],"b":"\\"topic\\":\\"/no\\"}"}'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f'{{"op":"publish","topic":"/t","type":"p/msg/T","time":5.5,{DATA}}}', ("/t", "p/msg/T")),
        (f' {{ "topic" : "\\/t" , "op":"publish",{DATA} , "time" : 5e9 }}\n', ("/t", None)),
        (f'{{{DATA},"op":"publish","time":5,"topic":"\\u002ft","type":"p/msg/T"}}', ("/t", "p/msg/T")),
        (f'{{"op":"publish",{DATA},"topic":"/t","type":null}}', ("/t", None)),
        (f'{{"type":"p/msg/T",{DATA},"topic":"/t,\\"}}"}}', ('/t,"}', "p/msg/T")),
    ],
)
def test_what_a_long_request_is_about_is_seen_without_its_data(text: str, expected: tuple[str, str]) -> None:
    assert heading(text.encode()) == expected
    assert json.loads(text)["topic"] == expected[0]


@pytest.mark.parametrize(
    "text",
    [
        "",
        f"{{{DATA}}}",
        f'{{"op":"publish",{DATA}}}',
        f'{{"op":"publish","topic":null,{DATA}}}',
        f'{{"op":"publish","topic":7,{DATA}}}',
        f'{{"to\\u0070ic":"/t",{DATA}}}',
        f'{{{DATA},"x":"a,\\"topic\\":\\"/t\\"}}',
        f"{{{DATA}}}" + ',"topic":"/t"' * 1000,
        f"{{{' ' * 5000}}}",
    ],
)
def test_a_long_request_whose_topic_is_not_to_be_seen_is_refused(text: str) -> None:
    with pytest.raises((PacketError, InvalidMessageError)):
        heading(text.encode())


@given(st.permutations(["op", "topic", "type", "time", "data"]), st.text(max_size=30), st.booleans())
def test_the_topic_of_any_long_request_is_seen(order: list[str], topic: str, ascii_only: bool) -> None:
    whole = {"op": "publish", "topic": topic, "type": "p/msg/T", "time": 1.5, "data": {"a": [1] * 3000, "topic": "/no"}}
    text = json.dumps({name: whole[name] for name in order}, ensure_ascii=ascii_only)
    assert heading(text.encode("utf-8", "surrogatepass")) == (topic, "p/msg/T")


@given(st.binary(max_size=60))
def test_any_bytes_are_a_request_or_refused(text: bytes) -> None:
    with pytest.raises((PacketError, InvalidMessageError)):
        request(text)

from __future__ import annotations

import json
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.documents import data_document, schema_document
from router.gateway.packets import Packet, pack
from router.tools.gateway_client import GatewayClient, Message, Received, Schema, Shape, json_line, pieces, topic_filter
from router.tools.gateway_sources import Arrival, Source, open_source
from tests.ports import free_port

EVERY = topic_filter([])

SCHEMA = json.dumps(
    {
        "name": "T",
        "namespace": "p::msg",
        "fields": [{"name": "x", "is_array": False, "type": "int32", "subtype": "primitive"}],
    }
)


def packet(payload: str, topic: str = "/t") -> bytes:
    return pack(Packet(5.0, False, topic, "p/msg/T", payload.encode()))


class Played:
    """A source of these arrivals, and the end of patience after them."""

    place = "nowhere"

    def __init__(self, *batches: Sequence[Arrival], lost: int = 0) -> None:
        self.lost = lost
        self.asked = 0
        self._batches = list(batches)

    def ask(self) -> None:
        self.asked += 1

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        if not self._batches:
            raise KeyboardInterrupt
        return self._batches.pop(0)

    def close(self) -> None: ...


def heard(listening: GatewayClient, source: Source) -> list[Received]:
    found: list[Received] = []
    try:
        found.extend(listening.receive(source, 100.0))
    except KeyboardInterrupt:
        return found
    raise AssertionError("the time was not over")


def arrivals(*packets: bytes, sender: object = "a") -> list[Arrival]:
    return [Arrival(data, sender) for data in packets]


def test_a_message_before_its_schema_is_shown_and_counted() -> None:
    sent = arrivals(packet('{"x":[1]}'), packet(SCHEMA), packet('{"x":[2]}'))
    listening, source = GatewayClient(EVERY), Played(sent)
    first, _, second = heard(listening, source)
    assert [getattr(each, "shape", None) for each in (first, second)] == [None, {"x": Shape("int32", False, {})}]
    assert str(listening.tally(source)) == "2 messages, 1 schemas, 0 undecodable, 0 lost, 1 before their schema"


def test_another_sender_has_to_send_its_schema_first() -> None:
    documents = schema_document("p/msg/T", 5.0, SCHEMA), data_document("/t", "p/msg/T", 5.0, b'{"x":1}')
    listening, source = GatewayClient(EVERY), Played(arrivals(*documents), arrivals(documents[1], sender="b"))
    heard(listening, source)
    assert listening.tally(source).early == 1


def test_schemas_of_other_topics_are_not_shown() -> None:
    schemas = [schema_document(name, 5.0, SCHEMA) for name in ("p/msg/S", "p/msg/T", "p/msg/U")]
    values = [data_document(topic, name, 5.0, b'{"x":1}') for topic, name in (("/a", "p/msg/S"), ("/b", "p/msg/T"))]
    listening, source = GatewayClient(lambda topic: topic == "/b"), Played(arrivals(*schemas, *values, values[1]))
    schema, *messages = heard(listening, source)
    assert isinstance(schema, Schema)
    assert schema.type_name == "p/msg/T"
    assert [type(one) for one in messages] == [Message, Message]
    assert str(listening.tally(source)) == "2 messages, 3 schemas, 0 undecodable, 0 lost, 1 of other topics"


NAMES = ["op", "name", "namespace", "fields", "time", "topic", "type", "is_array", "subtype", "x", "data", "schema"]
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from(["message", "float32"])
JSON = st.dictionaries(
    st.sampled_from(NAMES),
    st.recursive(
        LEAVES, lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.sampled_from(NAMES), inner), max_leaves=9
    ),
)
HOSTILE = st.one_of(
    st.binary(max_size=60),
    JSON.map(lambda content: packet(json.dumps(content))),
    JSON.map(lambda content: json.dumps(content).encode()),
    st.builds(
        lambda op, content: json.dumps(content | op).encode(), st.sampled_from([{"op": "data"}, {"op": "topics"}]), JSON
    ),
)


@given(st.lists(HOSTILE, max_size=4))
def test_whatever_arrives_can_be_shown(sent: list[bytes]) -> None:
    listening = GatewayClient(EVERY)
    for arrival in arrivals(packet(SCHEMA), *sent):
        for one in listening.take(arrival):
            assert all(text.isprintable() for text, _ in pieces(one))
            assert "\n" not in json_line(one)


def test_what_a_source_knows_to_be_lost_counts_and_schemas_are_asked_for_once() -> None:
    listening, source = GatewayClient(EVERY), Played([], [], arrivals(packet(SCHEMA)), lost=3)
    heard(listening, source)
    assert (listening.tally(source).lost, source.asked) == (3, 1)


def test_schemas_are_asked_for_until_one_came(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("router.tools.gateway_client.ASK_AGAIN", 0.01)

    class Patient(Played):
        def arrivals(self, timeout: float) -> Sequence[Arrival]:
            return super().arrivals(timeout) if self.asked > 2 else ()

    source = Patient(arrivals(packet(SCHEMA)))
    heard(GatewayClient(EVERY), source)
    assert source.asked == 3


def silent(line: str) -> None:
    raise AssertionError(line)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("udp://127.0.0.1:{port}", "udp 127.0.0.1:{port}"),
        ("udp://{port}", "udp 0.0.0.0:{port}"),
        ("tcp://127.0.0.1:8600", "tcp 127.0.0.1:8600"),
        ("ws://127.0.0.1:8765", "websocket 127.0.0.1:8765"),
        ("ws://127.0.0.1:8765/", "websocket 127.0.0.1:8765"),
        ("zenoh://rovers/loki_1?listen=tcp/127.0.0.1:0", "zenoh rovers/loki_1"),
    ],
)
def test_a_scheme_chooses_the_transport(text: str, place: str) -> None:
    port = free_port()
    source = open_source(text.format(port=port), None, None, silent)
    assert source.place == place.format(port=port)
    source.close()


def test_one_of_several_globs_is_enough_and_none_means_all() -> None:
    wants = topic_filter(["/a", "/b/*"])
    assert [wants(topic) for topic in ("/a", "/b/c", "/c", "/b")] == [True, True, False, False]
    assert topic_filter([])("any\nthing")

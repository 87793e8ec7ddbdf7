"""JSON documents between a gateway and its clients. Each is one object; `op` is its kind.

    {"op": "data", "topic": T, "type": N, "time": S, "data": {...}}      to the client
    {"op": "schema", "type": N, "time": S, "schema": {...}}
    {"op": "topics", "time": S, "topics": [{"topic": T, "type": N, "rate": HZ}]}
    {"op": "inbound", "topics": [{"topic": T, "type": N, "schema": {...}, "example": {...}}]}
    {"op": "rejected", "reason": R, "detail": TEXT, "topic": T}
    {"op": "publish", "topic": T, "type": N, "time": S, "data": {...}}   to the gateway; type and time may be left out
    {"op": "schema", "type": N}                                          requests a schema; all without `type`
    {"op": "call", "service": S, "id": I, "type": N, "time": S, "request": {...}}   calls a service, likewise
    {"op": "response", "id": I, "response": {...}}                       to the client; or with "reason": TEXT

Times are wall-clock seconds. No document has a newline in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, NamedTuple, Union

import msgspec
import orjson

from router.gateway.json_codec import reader, shown
from router.gateway.json_types import Style, example, schema_text
from router.gateway.packets import PacketError
from router.types.model import MessageType


class PublishRequest(NamedTuple):
    """A client's message: its JSON text, in a zstd frame if `is_compressed`. `time` is when the client sent it."""

    topic: str
    type_name: str | None
    time: float | None
    data: bytes
    is_compressed: bool = False


class SchemaRequest(NamedTuple):
    """A client's request for the schema of a type, or of all types."""

    type_name: str | None


class CallRequest(NamedTuple):
    """A client's call of a service: the JSON text of its request. The response has the same `id`. `time` as above."""

    service: str
    type_name: str | None
    time: float | None
    id: int
    data: bytes


Request = Union[PublishRequest, SchemaRequest, CallRequest]


def data_document(topic: str, type_name: str, time: float, text: bytes) -> bytes:
    """Make a message document from the JSON text of a message."""
    names = b'"topic":%b,"type":%b' % (orjson.dumps(topic), orjson.dumps(type_name))
    return b'{"op":"data",%b,"time":%b,"data":%b}' % (names, orjson.dumps(time), text)


def schema_document(type_name: str, time: float, text: str) -> bytes:
    """Make a schema document from the JSON text of a schema."""
    return orjson.dumps({"op": "schema", "type": type_name, "time": time, "schema": orjson.Fragment(text)})


def topics_document(time: float, rates: Iterable[tuple[str, str, float]]) -> bytes:
    """Make a document of the topics that are served: name, type, and incoming messages per second."""
    topics = [{"topic": topic, "type": type_name, "rate": rate} for topic, type_name, rate in rates]
    return orjson.dumps({"op": "topics", "time": time, "topics": topics})


def inbound_document(types: Mapping[str, MessageType]) -> bytes:
    """Make a document of the topics that clients may publish on, with their types."""
    topics = [
        {
            "topic": topic,
            "type": type_.name,
            "schema": orjson.Fragment(schema_text(type_, Style.PLAIN)),
            "example": example(type_),
        }
        for topic, type_ in types.items()
    ]
    return orjson.dumps({"op": "inbound", "topics": topics})


def rejected_document(reason: str, detail: str, topic: str) -> bytes:
    """Make a document that says why a client's message was rejected: one of GATEWAY_REJECT_REASONS, and a sentence."""
    return orjson.dumps({"op": "rejected", "reason": reason, "detail": detail, "topic": topic})


def response_document(number: int, text: bytes) -> bytes:
    """Make a document of a response to the call with this `id` from its JSON text."""
    return b'{"op":"response","id":%d,"response":%b}' % (number, text)


def no_response_document(number: int, reason: str) -> bytes:
    """Make a document that says why a call has no response."""
    return orjson.dumps({"op": "response", "id": number, "reason": reason})


class _Publish(msgspec.Struct, tag_field="op", tag="publish", forbid_unknown_fields=True, gc=False):
    topic: str
    data: msgspec.Raw
    type: str | None = None
    time: float | None = None


class _Schema(msgspec.Struct, tag_field="op", tag="schema", forbid_unknown_fields=True, gc=False):
    type: str | None = None


class _Call(msgspec.Struct, tag_field="op", tag="call", forbid_unknown_fields=True, gc=False):
    service: str
    id: Annotated[int, msgspec.Meta(ge=-(1 << 53), le=1 << 53)]  # what JavaScript represents
    request: msgspec.Raw
    type: str | None = None
    time: float | None = None


_read = reader(msgspec.json.Decoder(Union[_Publish, _Schema, _Call]))


def request(text: bytes) -> Request:
    """Parse a client's document, but not the data of a message. Raises PacketError if it is not a request."""
    try:
        document = _read(text)
    except msgspec.ValidationError as error:
        raise PacketError(f"not a request: {shown(str(error))}") from None
    if isinstance(document, _Schema):
        return SchemaRequest(document.type)
    if isinstance(document, _Call):
        return CallRequest(document.service, document.type, document.time, document.id, bytes(document.request))
    return PublishRequest(document.topic, document.type, document.time, bytes(document.data))

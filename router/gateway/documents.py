"""JSON documents between a gateway and its clients: one object each, whose `op` says what it is.

    {"op": "data", "topic": T, "type": N, "time": S, "data": {...}}      to the client
    {"op": "schema", "type": N, "time": S, "schema": {...}}
    {"op": "topics", "time": S, "topics": [{"topic": T, "type": N, "rate": HZ}]}
    {"op": "inbound", "topics": [{"topic": T, "type": N, "schema": {...}, "example": {...}}]}
    {"op": "rejected", "reason": R, "detail": TEXT, "topic": T}
    {"op": "publish", "topic": T, "type": N, "time": S, "data": {...}}   to the gateway; type and time may be left out
    {"op": "schema", "type": N}                                          asks for schemas, of all without a type

Times are wall-clock seconds. No document has a newline in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Union

import msgspec
import orjson

from router.gateway.json_codec import reader, shown
from router.gateway.json_types import example, schema_text
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
    """A client wants the schema of a type, or of all."""

    type_name: str | None


Request = Union[PublishRequest, SchemaRequest]


def data_document(topic: str, type_name: str, time: float, text: bytes) -> bytes:
    """A message whose JSON text is `text`."""
    names = b'"topic":%b,"type":%b' % (orjson.dumps(topic), orjson.dumps(type_name))
    return b'{"op":"data",%b,"time":%b,"data":%b}' % (names, orjson.dumps(time), text)


def schema_document(type_name: str, time: float, text: str) -> bytes:
    """A type whose schema is the JSON text `text`."""
    return orjson.dumps({"op": "schema", "type": type_name, "time": time, "schema": orjson.Fragment(text)})


def topics_document(time: float, rates: Iterable[tuple[str, str, float]]) -> bytes:
    """The topics that are served: name, type, and messages per second as they come in."""
    topics = [{"topic": topic, "type": type_name, "rate": rate} for topic, type_name, rate in rates]
    return orjson.dumps({"op": "topics", "time": time, "topics": topics})


def inbound_document(types: Mapping[str, MessageType]) -> bytes:
    """The topics that clients may publish on, and their types."""
    topics = [
        {"topic": topic, "type": type_.name, "schema": orjson.Fragment(schema_text(type_)), "example": example(type_)}
        for topic, type_ in types.items()
    ]
    return orjson.dumps({"op": "inbound", "topics": topics})


def rejected_document(reason: str, detail: str, topic: str) -> bytes:
    """Why a client's message is not published: one of GATEWAY_REJECT_REASONS, and a sentence."""
    return orjson.dumps({"op": "rejected", "reason": reason, "detail": detail, "topic": topic})


class _Publish(msgspec.Struct, tag_field="op", tag="publish", forbid_unknown_fields=True, gc=False):
    topic: str
    data: msgspec.Raw
    type: str | None = None
    time: float | None = None


class _Schema(msgspec.Struct, tag_field="op", tag="schema", forbid_unknown_fields=True, gc=False):
    type: str | None = None


_read = reader(msgspec.json.Decoder(Union[_Publish, _Schema]))


def request(text: bytes) -> Request:
    """What a client asks for. The data of a message are not read yet. Raises PacketError for what is no request."""
    try:
        found = _read(text)
    except msgspec.ValidationError as error:
        raise PacketError(f"not a request: {shown(str(error))}") from None
    if isinstance(found, _Schema):
        return SchemaRequest(found.type)
    return PublishRequest(found.topic, found.type, found.time, bytes(found.data))

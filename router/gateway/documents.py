"""JSON documents between a gateway and its clients: one object each, whose `op` says what it is.

    {"op": "data", "topic": T, "type": N, "time": S, "data": {...}}      to the client
    {"op": "schema", "type": N, "time": S, "schema": {...}}
    {"op": "topics", "time": S, "topics": [{"topic": T, "type": N, "rate": HZ}]}
    {"op": "inbound", "topics": [{"topic": T, "type": N, "schema": {...}, "example": {...}}]}
    {"op": "rejected", "reason": R, "detail": TEXT, "topic": T}
    {"op": "publish", "topic": T, "type": N, "time": S, "data": {...}}   to the gateway; type and time may be left out
    {"op": "schema", "type": N}                                          asks for schemas, of all without a type

Times are wall-clock seconds. No document has a newline in it. Knows no topics and no types.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple, Union

from router.gateway.json_reading import parse_json
from router.gateway.packets import PacketError


class TopicRow(NamedTuple):
    """A topic that is served; `rate` in messages per second as they come in."""

    topic: str
    type_name: str
    rate: float


class InboundRow(NamedTuple):
    """A topic that clients may publish on: the JSON text of its schema, and a message of defaults as plain data."""

    topic: str
    type_name: str
    schema: str
    example: object


class PublishRequest(NamedTuple):
    """A client's message. `time` is when the client sent it."""

    topic: str
    type_name: str | None
    time: float | None
    data: object


class SchemaRequest(NamedTuple):
    """A client wants the schema of a type, or of all."""

    type_name: str | None


Request = Union[PublishRequest, SchemaRequest]


class Heading(NamedTuple):
    """What a publish request says besides its data."""

    topic: str
    type_name: str | None


_SEEN = 1 << 10
"""Bytes at a document's beginning and end in which a topic and a type of 255 bytes have room."""
_MEMBER = rb'\s*"(op|topic|type|time)"\s*:\s*("[^"\\]*(?:\\.[^"\\]*)*"|[^\s",\[\]{}]{1,64})\s*'
_ONE = re.compile(_MEMBER)
_BEFORE = re.compile(rb"\s*\{(?:%b,){1,4}" % _MEMBER)
_BEHIND = re.compile(rb",%b(?:,%b){0,3}\}\s*\Z" % (_MEMBER, _MEMBER))


def data_document(topic: str, type_name: str, time: float, text: str) -> bytes:
    """A message whose JSON text is `text`."""
    names = f'"topic":{json.dumps(topic)},"type":{json.dumps(type_name)}'
    return f'{{"op":"data",{names},"time":{time!r},"data":{text}}}'.encode()


def schema_document(type_name: str, time: float, text: str) -> bytes:
    """A type whose schema is the JSON text `text`."""
    return f'{{"op":"schema","type":{json.dumps(type_name)},"time":{time!r},"schema":{text}}}'.encode()


def topics_document(time: float, rows: Iterable[TopicRow]) -> bytes:
    topics = [{"topic": row.topic, "type": row.type_name, "rate": row.rate} for row in rows]
    return _document({"op": "topics", "time": time, "topics": topics})


def inbound_document(rows: Iterable[InboundRow]) -> bytes:
    topics = [
        {"topic": row.topic, "type": row.type_name, "schema": json.loads(row.schema), "example": row.example}
        for row in rows
    ]
    return _document({"op": "inbound", "topics": topics})


def rejected_document(reason: str, detail: str, topic: str) -> bytes:
    """Why a client's message is not published: one of GATEWAY_REJECT_REASONS, and a sentence."""
    return _document({"op": "rejected", "reason": reason, "detail": detail, "topic": topic})


def _document(content: Mapping[str, object]) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode()


def request(text: bytes) -> Request:
    """What a client asks for. Raises PacketError for what is no request, InvalidMessageError for what is no JSON."""
    document = parse_json(text)
    if not isinstance(document, dict):
        raise PacketError("a request is a JSON object")
    match document.get("op"):
        case "publish":
            _check_keys(document, {"op", "topic", "type", "time", "data"})
            return _publish_request(document)
        case "schema":
            _check_keys(document, {"op", "type"})
            return SchemaRequest(_type_name(document))
    raise PacketError("'op' is neither publish nor schema")


def heading(text: bytes) -> Heading:
    """That of a long document, without reading its data, which stands before or behind all else. If the document is a
    request at all, it is one with this heading. Raises PacketError where there is none, InvalidMessageError.
    """
    spans = [found.group() for found in (_BEFORE.match(text[:_SEEN]), _BEHIND.search(text[-_SEEN:])) if found]
    said = {name: value for span in spans for name, value in _ONE.findall(span)}
    topic, type_name = (parse_json(said.get(name, b"null")) for name in (b"topic", b"type"))
    if not isinstance(topic, str) or not isinstance(type_name, (str, type(None))):
        raise PacketError("a long request names its topic, and maybe its type, before its data or behind them")
    return Heading(topic, type_name)


def _publish_request(document: Mapping[str, object]) -> PublishRequest:
    topic = document.get("topic")
    if not isinstance(topic, str):
        raise PacketError("'topic' is not a text")
    if "data" not in document:
        raise PacketError("there is no 'data'")
    return PublishRequest(topic, _type_name(document), _time(document), document["data"])


def _check_keys(document: Mapping[str, object], known: Collection[str]) -> None:
    if unknown := sorted(document.keys() - known):
        raise PacketError(f"a request of this kind has no '{unknown[0]}'")


def _type_name(document: Mapping[str, object]) -> str | None:
    type_name = document.get("type")
    if type_name is not None and not isinstance(type_name, str):
        raise PacketError("'type' is not a text")
    return type_name


def _time(document: Mapping[str, object]) -> float | None:
    time = document.get("time")
    if time is None:
        return None
    if isinstance(time, bool) or not isinstance(time, (int, float)):
        raise PacketError("'time' is not a number")
    return float(time)

"""One packet or document of a gateway taken apart: a message, a schema, or what else a gateway says.

Knows no sockets, and nothing of what came before.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple, Union

from router.gateway.compression import decompress
from router.gateway.packets import HEAD, Packet, PacketError, unpack

MOST_TEXT = 256 << 20
"""Bytes of the longest message that a gateway can be told to send."""

_MOST_DEEP = 64
"""Lists and objects within each other. Messages have a few."""


class Shape(NamedTuple):
    """What a schema says of a field; `members` of a message, by name."""

    type_name: str
    is_array: bool
    members: Mapping[str, Shape]


class Message(NamedTuple):
    """A topic's message as received. In packets every single value is a list of one: `is_wrapped`.

    `time` is the sender's wall clock, seconds since 1970. `shape` is None before the schema came.
    """

    time: float
    topic: str
    type_name: str
    data: Mapping[str, Any]
    is_wrapped: bool
    shape: Mapping[str, Shape] | None = None


class Schema(NamedTuple):
    """The schema of a type, as received and taken apart. `topic` is empty in documents."""

    time: float
    topic: str
    type_name: str
    schema: Mapping[str, Any]
    shape: Mapping[str, Shape]


class Remark(NamedTuple):
    """A document that is neither: which topics there are, what is taken, what was refused."""

    document: Mapping[str, Any]


class Problem(NamedTuple):
    """Bytes that mean nothing, and why."""

    reason: str
    data: bytes


Heard = Union[Message, Schema, Remark, Problem]


def read(data: bytes) -> Message | Schema | Remark:
    """What a packet or document says. Raises PacketError."""
    # At a packet's ninth byte is 0 or 1, which no text has.
    if data[:1] == b"{" and (len(data) < HEAD.size or data[HEAD.size - 1] > 1):
        return _document(_object(data))
    return _packet(unpack(data))


def _packet(packet: Packet) -> Message | Schema:
    text = decompress(packet.payload, MOST_TEXT) if packet.is_compressed else packet.payload
    content = _object(text)
    if _is_schema(content):
        return Schema(packet.time, packet.topic, packet.type_name, content, shape(content))
    return Message(packet.time, packet.topic, packet.type_name, content, is_wrapped=True)


def _is_schema(content: Mapping[str, Any]) -> bool:
    """Nothing else tells. In a message these would be lists, all three."""
    return content.keys() >= {"name", "namespace", "fields"} and isinstance(content["name"], str)


def _document(document: Mapping[str, Any]) -> Message | Schema | Remark:
    op = document.get("op")
    if not isinstance(op, str):
        raise PacketError("a document that does not say what it is")
    if op not in {"data", "schema"}:
        return Remark(document)
    time, type_name = document.get("time"), document.get("type")
    if not isinstance(time, (int, float)) or not isinstance(type_name, str):
        raise PacketError("a document without time or type")
    if op == "schema":
        return Schema(time, "", type_name, document.get("schema", {}), shape(document.get("schema")))
    topic, data = document.get("topic"), document.get("data")
    if not isinstance(topic, str) or not isinstance(data, dict):
        raise PacketError("a document without topic or data")
    return Message(time, topic, type_name, data, is_wrapped=False)


def _object(text: bytes) -> dict[str, Any]:
    try:
        value = json.loads(text.decode())
    except (ValueError, RecursionError) as error:
        raise PacketError(f"no JSON: {error}") from error
    if not isinstance(value, dict):
        raise PacketError("JSON that is no object")
    _check_depth(value)
    return value


def _check_depth(value: Mapping[str, Any]) -> None:
    level: list[Any] = [value]
    for _ in range(_MOST_DEEP):
        holders = (holder.values() if isinstance(holder, dict) else holder for holder in level)
        level = [child for holder in holders for child in holder if isinstance(child, (dict, list))]
        if not level:
            return
    raise PacketError(f"JSON with more than {_MOST_DEEP} levels")


def shape(schema: object) -> Mapping[str, Shape]:
    """The fields of `{"fields": [{"name", "is_array", "type", "subtype"}]}`. Raises PacketError."""
    try:
        return {field["name"]: _field(field) for field in schema["fields"]}  # type: ignore[index]
    except (KeyError, TypeError) as error:
        raise PacketError(f"no schema: {error!r}") from error


def _field(field: Mapping[str, Any]) -> Shape:
    if field["type"] != "message":
        return Shape(str(field["type"]), bool(field["is_array"]), {})
    subtype = field["subtype"]
    return Shape(str(subtype["name"]), bool(field["is_array"]), shape(subtype))

"""A reference client of gateways: decodes, counts and filters what a source delivers, and prints it.

Packets and documents are printed as a line of values or as JSON.
"""

from __future__ import annotations

import datetime as dt
import json
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Union

from router.compiler.selection import matcher, pattern_problem
from router.errors import SourceSpan, UsageError
from router.gateway.packets import HEAD, Packet, PacketError, decompress, unbatched, unpack
from router.table.model.gateways import TopicPattern
from router.tools.gateway_sources import MOST_TEXT, Arrival, Source
from router.values.printing import SHOWN_ELEMENTS, Tree, clock_text, list_text, one_line, plain_text, words

# Decoding

_MOST_DEEP = 64
"""Deepest nesting of lists and objects that is accepted."""


class Shape(NamedTuple):
    """A field as a schema describes it; `members` of a message, by name."""

    type_name: str
    is_array: bool
    members: Mapping[str, Shape]


class Message(NamedTuple):
    """A topic's message as received. `is_wrapped`: every single value is a list of one, as in packets.

    `time` is the sender's wall clock, seconds since 1970. `shape` is None until the schema has arrived.
    """

    time: float
    topic: str
    type_name: str
    data: Mapping[str, Any]
    is_wrapped: bool
    shape: Mapping[str, Shape] | None = None


class Schema(NamedTuple):
    """The schema of a type, as received and as decoded. `topic` is empty in documents."""

    time: float
    topic: str
    type_name: str
    schema: Mapping[str, Any]
    shape: Mapping[str, Shape]


class Remark(NamedTuple):
    """Any other document: the list of topics, an acknowledgement, a rejection."""

    document: Mapping[str, Any]


class Problem(NamedTuple):
    """Bytes that cannot be decoded, and why."""

    reason: str
    data: bytes


Received = Union[Message, Schema, Remark, Problem]


def read(data: bytes) -> Message | Schema | Remark:
    """Decode a packet or a document. Raises PacketError."""
    # The ninth byte of a packet is 0 or 1, which no text contains.
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
    """Return whether it is a schema; in a message all three values would be lists."""
    return content.keys() >= {"name", "namespace", "fields"} and isinstance(content["name"], str)


def _document(document: Mapping[str, Any]) -> Message | Schema | Remark:
    op = document.get("op")
    if not isinstance(op, str):
        raise PacketError("a document of unknown kind")
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
        raise PacketError(f"not JSON: {error}") from error
    if not isinstance(value, dict):
        raise PacketError("JSON that is not an object")
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
    """Return the fields of `{"fields": [{"name", "is_array", "type", "subtype"}]}`. Raises PacketError."""
    try:
        return {field["name"]: _field(field) for field in schema["fields"]}  # type: ignore[index]
    except (KeyError, TypeError) as error:
        raise PacketError(f"not a schema: {error!r}") from error


def _field(field: Mapping[str, Any]) -> Shape:
    if field["type"] != "message":
        return Shape(str(field["type"]), bool(field["is_array"]), {})
    subtype = field["subtype"]
    return Shape(str(subtype["name"]), bool(field["is_array"]), shape(subtype))


# Receiving

PATIENCE = 0.2
"""Longest wait of a source in seconds, so that Ctrl-C and the end of `seconds` are noticed."""

ASK_AGAIN = 1.0
"""Seconds between two requests for schemas."""


@dataclass(slots=True)
class Tally:
    """Counts. `early` messages came before their schema, `unwanted` ones are of other topics."""

    messages: int = 0
    schemas: int = 0
    undecodable: int = 0
    lost: int = 0
    early: int = 0
    unwanted: int = 0

    def __str__(self) -> str:
        text = f"{self.messages} messages, {self.schemas} schemas, {self.undecodable} undecodable, {self.lost} lost"
        if self.early:
            text += f", {self.early} before their schema"
        return text + (f", {self.unwanted} of other topics" if self.unwanted else "")


class GatewayClient:
    """Decodes arrivals. `wants` selects topics; `wants("")` says whether all topics are wanted.

    A schema without a topic is shown before the first wanted message of its type.
    """

    def __init__(self, wants: Callable[[str], bool]) -> None:
        self._wants = wants
        self._held: dict[tuple[Hashable, str], Schema] = {}
        self._tally = Tally()
        self._shapes: dict[tuple[Hashable, str], Mapping[str, Shape]] = {}

    def tally(self, source: Source) -> Tally:
        self._tally.lost = source.lost
        return self._tally

    def receive(self, source: Source, seconds: float) -> Iterator[Received]:
        """Decode what the source delivers within `seconds`, and yield the wanted part."""
        ends, asks = time.monotonic() + seconds, 0.0
        while (now := time.monotonic()) < ends:
            if not self._tally.schemas and now >= asks:
                source.ask()
                asks = now + ASK_AGAIN
            for arrival in source.arrivals(min(PATIENCE, ends - now)):
                yield from self.take(arrival)

    def take(self, arrival: Arrival) -> Iterator[Received]:
        """Decode one arrival, and yield the wanted part."""
        try:
            packets = unbatched(arrival.data)
        except PacketError as error:
            yield self._problem(error, arrival.data)
            return
        for packet in packets:
            try:
                received = read(packet)
            except PacketError as error:
                yield self._problem(error, packet)
            else:
                yield from self._counted(received, arrival.sender)

    def _counted(self, received: Message | Schema | Remark, sender: Hashable) -> Iterator[Received]:
        """Count a message or schema, and yield it if it is wanted, after its schema."""
        if isinstance(received, Remark):
            yield received
        elif isinstance(received, Schema):
            yield from self._schema(received, sender)
        elif not self._wants(received.topic):
            self._tally.unwanted += 1
        else:
            if (held := self._held.pop((sender, received.type_name), None)) is not None:
                yield held
            shape = self._shapes.get((sender, received.type_name))
            self._tally.messages += 1
            self._tally.early += shape is None
            yield received._replace(shape=shape)

    def _schema(self, schema: Schema, sender: Hashable) -> Iterator[Schema]:
        self._tally.schemas += 1
        self._shapes[sender, schema.type_name] = schema.shape
        if self._wants(schema.topic):
            yield schema
        elif not schema.topic:
            self._held[sender, schema.type_name] = schema

    def _problem(self, error: PacketError, data: bytes) -> Problem:
        self._tally.undecodable += 1
        return Problem(str(error), data)


_COMMAND_LINE = SourceSpan("command line", 1, 1)


def topic_filter(globs: Sequence[str]) -> Callable[[str], bool]:
    """Return a predicate: whether any glob matches a topic. Without globs, every topic matches. Raises UsageError."""
    patterns = [TopicPattern(glob, is_regex=False, span=_COMMAND_LINE) for glob in globs]
    for problem in filter(None, map(pattern_problem, patterns)):
        raise UsageError(f"--topic: {problem.what}", problem.hint)
    matchers = [matcher(pattern) for pattern in patterns]
    return lambda topic: not matchers or any(matches(topic) for matches in matchers)


# Printing

Piece = tuple[str, str]
"""Text, and a style of rich."""

_LONGEST_TEXT = 120
"""Characters shown of a string."""

_MOST_BYTES = 60
"""Bytes shown of an undecodable packet."""

_NO_SHAPE: Mapping[str, Shape] = {}


def json_line(received: Received) -> str:
    """Return one JSON object with the data as received."""
    return json.dumps(_as_json(received), separators=(",", ":"))


def _as_json(received: Received) -> Mapping[str, object]:
    if isinstance(received, Remark):
        return received.document
    if isinstance(received, Problem):
        return {"problem": received.reason, "bytes": len(received.data), "hex": received.data.hex()}
    if isinstance(received, Message):
        return {"time": received.time, "topic": received.topic, "type": received.type_name, "data": received.data}
    topic = {"topic": received.topic} if received.topic else {}
    return {"time": received.time, **topic, "type": received.type_name, "schema": received.schema}


def pieces(received: Received) -> list[Piece]:
    """Return one line in styled pieces: `12:00:00.123 /imu/data sensor_msgs/msg/Imu x=0.01`."""
    if isinstance(received, Message):
        values = _line(words(_tree(received.data, received.shape or _NO_SHAPE, received.is_wrapped)))
        return [
            (_clock(received.time), "dim"),
            _name(received.topic, "green"),
            _name(received.type_name, "dim"),
            (values, ""),
        ]
    if isinstance(received, Schema):
        fields = _line(f"{name}:{_type_text(shape)}" for name, shape in received.shape.items())
        where = [_name(received.topic, "green")] if received.topic else []
        return [(_clock(received.time), "dim"), *where, _name(received.type_name, "dim"), (f"schema {fields}", "cyan")]
    if isinstance(received, Problem):
        return [("undecodable", "red"), (f"({received.reason}):", ""), (_bytes_text(received.data), "")]
    return [(_line(_remark(received.document)), "yellow" if received.document["op"] == "rejected" else "dim")]


def _remark(document: Mapping[str, Any]) -> Iterable[str]:
    """Return a document as words; a list of topics as their names only."""
    if not isinstance(rows := document.get("topics"), list):
        return words(_tree(document, _NO_SHAPE, is_wrapped=False))
    names = (str(row["topic"]) for row in rows if isinstance(row, dict) and "topic" in row)
    return [document["op"], f"{len(rows)}:", *names]


def _clock(seconds: float) -> str:
    """Return the local time of day; the number if it is outside the calendar's range."""
    try:
        return clock_text(dt.datetime.fromtimestamp(seconds).astimezone())
    except (OverflowError, OSError, ValueError):
        return f"time={seconds}"


def _bytes_text(data: bytes) -> str:
    rest = f"...({len(data)} bytes)" if len(data) > _MOST_BYTES else ""
    return data[:_MOST_BYTES].hex() + rest or "no bytes"


def _name(text: str, style: str) -> Piece:
    return one_line([text]), style


def _line(listed: Iterable[str]) -> str:
    return one_line(listed, empty="(empty)")


def _type_text(shape: Shape) -> str:
    return shape.type_name + "[]" * shape.is_array


def _tree(values: Mapping[str, Any], shapes: Mapping[str, Shape], is_wrapped: bool) -> Mapping[str, Tree]:
    """Return the members as text. `is_wrapped`: a single value is in a list of one."""
    tree: dict[str, Tree] = {}
    for name, value in values.items():
        shape = shapes.get(name)
        if is_wrapped and shape is not None and not shape.is_array and isinstance(value, list) and len(value) == 1:
            [value] = value  # noqa: PLW2901
        if isinstance(value, list) and any(isinstance(element, dict) for element in value):
            for index, element in enumerate(value[:SHOWN_ELEMENTS]):
                tree[f"{name}[{index}]"] = _value(element, shape, is_wrapped)
            if len(value) > SHOWN_ELEMENTS:
                tree[name] = f"...({len(value)})"
        else:
            tree[name] = _value(value, shape, is_wrapped)
    return tree


def _value(value: Any, shape: Shape | None, is_wrapped: bool) -> Tree:
    if isinstance(value, dict):
        return _tree(value, shape.members if shape is not None else _NO_SHAPE, is_wrapped)
    if isinstance(value, list):
        return list_text((_text(element, shape) for element in value[:SHOWN_ELEMENTS]), len(value), SHOWN_ELEMENTS)
    return _text(value, shape)


def _text(value: Any, shape: Shape | None) -> str:
    if isinstance(value, str):
        return _cut(value)
    return plain_text(value, 32 if shape is not None and shape.type_name == "float32" else 64)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}...({len(text)})"

"""Received ROS messages, and the formats in which gateways send them: packets or JSON documents."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from math import inf
from typing import Any

from router.gateway.documents import PublishRequest, Request, SchemaRequest, data_document, request, schema_document
from router.gateway.json_codec import Encode, encoder
from router.gateway.json_types import Style, schema_text
from router.gateway.packets import HEAD, compress, datagrams, prefix, unpack
from router.gateway.transport.base import Frame
from router.table.model.gateways import Gateway, GatewayFormat, Transport
from router.table.units import LARGEST_DATAGRAM
from router.types.model import MessageType

LARGE = 64 << 10
"""Bytes above which a message is converted in another thread, so that smaller ones do not wait for it."""


class ReadyType:
    """A message type ready to be received: its definition, its rclpy class, its JSON schemas."""

    def __init__(self, message: MessageType, message_class: Any) -> None:
        self.message = message
        self.message_class = message_class
        self._schemas: dict[Style, str] = {}
        self._encoders: dict[Style, Encode] = {}

    def schema(self, style: Style) -> str:
        """Return the JSON schema."""
        if (schema := self._schemas.get(style)) is None:
            schema = self._schemas[style] = schema_text(self.message, style)
        return schema

    def text(self, style: Style, cdr: bytes) -> bytes:
        """Convert CDR to JSON. Raises UnreadableError if that is impossible."""
        if (encode := self._encoders.get(style)) is None:
            encode = self._encoders[style] = encoder(self.message, style)
        return encode(cdr)


class Sample:
    """One message. Its JSON is made once for all gateways that send it. Any thread may convert it.

    `sent_ns` is the wall clock when it was published.
    """

    __slots__ = ("_payloads", "_texts", "_type", "cdr", "sent_ns", "topic")

    def __init__(self, topic: str, ready: ReadyType, cdr: bytes, sent_ns: int) -> None:
        self.topic = topic
        self.cdr = cdr
        self.sent_ns = sent_ns
        self._type = ready
        self._texts: dict[Style, bytes] = {}
        self._payloads: dict[tuple[Style, int], bytes] = {}

    @property
    def type_name(self) -> str:
        return self._type.message.name

    def text(self, style: Style) -> bytes:
        """Return the message as UTF-8 JSON. Raises UnreadableError."""
        if (text := self._texts.get(style)) is None:
            text = self._texts[style] = self._type.text(style, self.cdr)
        return text

    def payload(self, style: Style, level: int) -> bytes:
        """Return the JSON, compressed with zstd unless `level` is 0. Raises UnreadableError."""
        if (payload := self._payloads.get((style, level))) is None:
            plain = self.text(style)
            payload = self._payloads[style, level] = compress(plain, level) if level else plain
        return payload

    def forget(self) -> None:
        """Forget its JSON, which is made again if it is needed."""
        self._texts.clear()
        self._payloads.clear()

    def has_payload(self, style: Style, level: int) -> bool:
        """Return whether `payload` and `text` have been made already."""
        return (style, level) in self._payloads


class Encoding(ABC):
    """Writes samples and schemas, and reads requests of clients. Times are wall-clock seconds."""

    style: Style
    level: int
    most: float
    """Bytes of the longest packet or document that the transport can send."""

    def __init__(self, settings: Gateway) -> None:
        self.level = settings.compression
        self.most = LARGEST_DATAGRAM if settings.transport.value is Transport.UDP else inf

    @abstractmethod
    def introduces(self, topic: str, type_name: str) -> Hashable:
        """Return the key of the schema that a client needs before this topic's data."""

    @abstractmethod
    def schema(self, topic: str, type_name: str, schema: str, time: float) -> bytes: ...

    @abstractmethod
    def data(self, sample: Sample, time: float) -> bytes:
        """Encode a message. Raises UnreadableError if it cannot be converted."""

    @abstractmethod
    def request(self, data: bytes) -> Request:
        """Parse what a client has sent. Raises PacketError if the format is wrong."""

    def on_wire(self, frames: Sequence[Frame], time: float) -> Sequence[Frame]:
        """Return the frames in the form in which the transport sends them."""
        return frames


class PacketEncoding(Encoding):
    """`gateway_v1`: one packet for each message and schema."""

    style = Style.WRAPPED

    def introduces(self, topic: str, type_name: str) -> Hashable:
        return topic, type_name  # each packet names both, and clients may keep schemas by either

    def schema(self, topic: str, type_name: str, schema: str, time: float) -> bytes:
        return HEAD.pack(time, 0) + prefix(topic, type_name) + schema.encode()

    def data(self, sample: Sample, time: float) -> bytes:
        payload = sample.payload(self.style, self.level)
        return HEAD.pack(time, self.level > 0) + prefix(sample.topic, sample.type_name) + payload

    def request(self, data: bytes) -> Request:
        packet = unpack(data)
        if not packet.payload:
            return SchemaRequest(packet.type_name or None)
        return PublishRequest(packet.topic, packet.type_name, packet.time, packet.payload, packet.is_compressed)


class BatchEncoding(PacketEncoding):
    """`gateway_v2`: several packets share a datagram of at most `max_datagram` bytes."""

    def __init__(self, settings: Gateway) -> None:
        super().__init__(settings)
        self._datagram = settings.max_datagram

    def on_wire(self, frames: Sequence[Frame], time: float) -> Sequence[Frame]:
        packets = (frame.data for frame in frames)
        return [Frame(datagram, "", "", is_schema=False) for datagram in datagrams(packets, self._datagram, time)]


class DocumentEncoding(Encoding):
    """`json` and `json_lines`: one document for each message and schema."""

    style = Style.PLAIN

    def introduces(self, topic: str, type_name: str) -> Hashable:
        return type_name

    def schema(self, topic: str, type_name: str, schema: str, time: float) -> bytes:
        return schema_document(type_name, time, schema)

    def data(self, sample: Sample, time: float) -> bytes:
        return data_document(sample.topic, sample.type_name, time, sample.text(self.style))

    def request(self, data: bytes) -> Request:
        return request(data)


ENCODINGS: Mapping[GatewayFormat, type[Encoding]] = {
    GatewayFormat.GATEWAY_V1: PacketEncoding,
    GatewayFormat.GATEWAY_V2: BatchEncoding,
    GatewayFormat.JSON: DocumentEncoding,
    GatewayFormat.JSON_LINES: DocumentEncoding,
}

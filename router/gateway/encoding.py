"""The formats of a gateway on the wire: packets with a binary header, or JSON documents."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from math import inf

from router.gateway.documents import PublishRequest, Request, SchemaRequest, data_document, request, schema_document
from router.gateway.json_types import Style
from router.gateway.packets import HEAD, datagrams, prefix, unpack
from router.gateway.samples import Sample
from router.gateway.transport.base import Frame
from router.table.model import Gateway, GatewayFormat, Transport
from router.table.units import LARGEST_DATAGRAM

LARGE = 64 << 10
"""Bytes of a message that is converted in a thread of its own, so that smaller ones need not wait for it."""


class Encoding(ABC):
    """How one gateway writes samples and schemas, and reads what clients send. Times are wall-clock seconds."""

    style: Style
    level: int
    most: float
    """Bytes of the longest packet or document that the transport can send."""

    def __init__(self, settings: Gateway) -> None:
        self.level = settings.compression
        self.most = LARGEST_DATAGRAM if settings.transport.value is Transport.UDP else inf

    @abstractmethod
    def introduces(self, topic: str, type_name: str) -> Hashable:
        """What a client must have a schema of before this topic's data."""

    @abstractmethod
    def schema(self, topic: str, type_name: str, schema: str, time: float) -> bytes: ...

    @abstractmethod
    def data(self, sample: Sample, time: float) -> bytes:
        """Raises UnreadableError."""

    @abstractmethod
    def request(self, data: bytes) -> Request:
        """What a client has sent. Raises PacketError for what has not the format, InvalidMessageError."""

    def on_wire(self, frames: Sequence[Frame], time: float) -> Sequence[Frame]:
        """The same frames as the transport is to send them."""
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
    """`gateway_v2`: packets share datagrams of at most `max_datagram` bytes."""

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

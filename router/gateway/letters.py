"""What clients send, before it is read: only what it is about, and how much there is to read. Knows no clients."""

from __future__ import annotations

from abc import ABC, abstractmethod

from router.gateway.compression import decompress, told_size
from router.gateway.documents import PublishRequest, Request, SchemaRequest, heading, request
from router.gateway.json_reading import parse_json
from router.gateway.packets import unpack

QUICK = 4 << 10
"""Bytes of JSON from a client that are read at once: of 64 KiB, the worst takes 30 ms."""


class Letter(ABC):
    """One packet or document. Made from bytes: raises PacketError, or InvalidMessageError."""

    topic: str | None = None
    """On which it is to be published; None where that is seen only when it is read, or it asks for schemas."""
    type_name: str | None = None
    size: int | None = None
    """Bytes of JSON; None where nothing tells."""

    @property
    def is_quick(self) -> bool:
        return self.size is not None and self.size <= QUICK

    @abstractmethod
    def read(self, most: int) -> Request:
        """Takes `most` bytes of JSON at most. Raises PacketError for what has not the format, InvalidMessageError for
        JSON that is none.
        """


class PacketLetter(Letter):
    def __init__(self, data: bytes) -> None:
        self._packet = unpack(data)
        payload = self._packet.payload
        self.size = told_size(payload) if self._packet.is_compressed else len(payload)
        if payload:
            self.topic, self.type_name = self._packet.topic, self._packet.type_name

    def read(self, most: int) -> Request:
        packet = self._packet
        if not packet.payload:
            return SchemaRequest(packet.type_name or None)
        text = decompress(packet.payload, most) if packet.is_compressed else packet.payload
        return PublishRequest(packet.topic, packet.type_name, packet.time, parse_json(text))


class DocumentLetter(Letter):
    def __init__(self, data: bytes) -> None:
        self._data = data
        self.size = len(data)
        if not self.is_quick:
            self.topic, self.type_name = heading(data)

    def read(self, most: int) -> Request:
        return request(self._data)

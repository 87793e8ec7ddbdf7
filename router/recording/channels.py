"""The channels of recordings: which there are, by number. Those of all files of a router have the same numbers.

A channel is what one sender sends of one payload case to one listener. Its metadata says so, and with the payload that
is all there is to the datagram (see `Holds`). Knows no file.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

from google.protobuf.descriptor import Descriptor
from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from router.recording.schemas import DATAGRAM, descriptor_set
from router.types.protobuf import PayloadCase

DATAGRAMS = "raw/datagrams"
"""The topic of datagrams as received. No payload case can have a slash in its name."""

MOST = 4096
"""Channels. Senders beyond that, as of somebody who changes his port each time, are recorded as raw datagrams."""

Peer = tuple[str, int]


class Holds(enum.Enum):
    """What a channel's messages are."""

    PAYLOAD = "payload"
    """Payloads of datagrams with one field, encoded as protobuf encodes it: tag and length follow from number and
    payload."""
    DATAGRAM = "datagram"
    """All that is no such datagram, byte for byte."""
    VIEW = "view"
    """Payloads of datagrams that are recorded raw as well: for who looks at them, not to be sent again."""


class Channels:
    """Gives numbers, the same ones for what is the same. They are never taken back."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._schema_ids: dict[tuple[str, bytes], int] = {}
        self._channel_ids: dict[tuple[object, ...], int] = {}

    def payload(self, case: PayloadCase, listener: str, peer: Peer, endpoint: str) -> int | None:
        """`endpoint` is what the table calls the sender, empty for a stranger. None where there are too many."""
        told = _told(case, Holds.PAYLOAD, listener=listener, peer=f"{peer[0]}:{peer[1]}", endpoint=endpoint)
        if len(self.channels) >= MOST and self._same(case.name, _payload(case), told) not in self._channel_ids:
            return None
        return self._channel(case.name, _payload(case), told)

    def view(self, case: PayloadCase) -> int:
        return self._channel(case.name, _payload(case), _told(case, Holds.VIEW))

    def datagrams(self) -> int:
        return self._channel(DATAGRAMS, DATAGRAM, {"holds": Holds.DATAGRAM.value})

    def _channel(self, topic: str, message: Descriptor, metadata: dict[str, str]) -> int:
        same = self._same(topic, message, metadata)
        if same not in self._channel_ids:
            number = self._channel_ids[same] = len(self.channels) + 1
            self.channels[number] = Channel(number, topic, MessageEncoding.Protobuf, metadata, self._schema(message))
        return self._channel_ids[same]

    def _same(self, topic: str, message: Descriptor, metadata: Mapping[str, str]) -> tuple[object, ...]:
        """What only one channel has."""
        return topic, self._schema(message), *metadata.values()

    def _schema(self, message: Descriptor) -> int:
        same = (message.full_name, descriptor_set(message))
        if same not in self._schema_ids:
            number = self._schema_ids[same] = len(self.schemas) + 1
            self.schemas[number] = Schema(
                id=number, name=message.full_name, encoding=SchemaEncoding.Protobuf, data=same[1]
            )
        return self._schema_ids[same]


def _told(case: PayloadCase, holds: Holds, **sender: str) -> dict[str, str]:
    return {"holds": holds.value, "number": str(case.number), **sender}


def _payload(case: PayloadCase) -> Descriptor:
    return case.message_class.DESCRIPTOR  # type: ignore[return-value]  # or upb's, which is the same


def varint(value: int) -> bytes:
    """As protobuf encodes tags and lengths."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*encoded, value))

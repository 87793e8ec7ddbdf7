"""Packets of the gateway: time, whether it is compressed, topic and type, payload. Knows no JSON, no sockets.

float64 LE   seconds since 1970
uint8        1 when the payload is a zstd frame, else 0
topic, NUL   UTF-8
type, NUL    as `sensor_msgs/msg/Imu`
payload      to the end; empty asks for schemas
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

HEAD = struct.Struct("<dB")
"""Time and kind, with which packets, batches and fragments begin."""

LONGEST_NAME = 255
"""Bytes of a topic or a type. ROS allows no longer topics."""


class PacketError(ValueError):
    """The sender's fault: bytes that are no packet."""


class TooLargeError(PacketError):
    """It holds more than is taken."""


class Packet(NamedTuple):
    """`time` is wall-clock seconds; `payload` is compressed when `is_compressed`."""

    time: float
    is_compressed: bool
    topic: str
    type_name: str
    payload: bytes


def prefix(topic: str, type_name: str) -> bytes:
    """What stands between head and payload."""
    return f"{topic}\0{type_name}\0".encode()


def pack(packet: Packet) -> bytes:
    return HEAD.pack(packet.time, packet.is_compressed) + prefix(packet.topic, packet.type_name) + packet.payload


def unpack(data: bytes) -> Packet:
    """The packet that these bytes are. Names are UTF-8, and nothing else is known of them. Raises PacketError."""
    if len(data) < HEAD.size:
        raise PacketError(f"{len(data)} bytes are no packet")
    time, kind = HEAD.unpack_from(data)
    if kind > 1:
        raise PacketError(f"a packet of kind {kind}, where 0 and 1 are known")
    if not math.isfinite(time):
        raise PacketError(f"the time is {time}")
    topic, start = _name(data, HEAD.size, "topic")
    type_name, start = _name(data, start, "type")
    return Packet(time, kind == 1, topic, type_name, data[start:])


def _name(data: bytes, start: int, what: str) -> tuple[str, int]:
    """The text that ends with the next NUL, and where what follows begins."""
    end = data.find(0, start, start + LONGEST_NAME + 1)
    if end < 0:
        raise PacketError(f"the {what} does not end within {LONGEST_NAME} bytes")
    try:
        return data[start:end].decode(), end + 1
    except UnicodeDecodeError as error:
        raise PacketError(f"the {what} is not UTF-8") from error

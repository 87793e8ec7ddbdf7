"""Packets of a gateway (`gateway_v1`), their compression, and batches of them in one datagram (`gateway_v2`).

A packet is

    float64 LE   seconds since 1970
    uint8        1 when the payload is a zstd frame, else 0
    topic, NUL   UTF-8
    type, NUL    as `sensor_msgs/msg/Imu`
    payload      to the end; empty asks for schemas

and a batch is time and the kind 2, then a uint16 LE length and a packet, again and again.
"""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from backports import zstd

HEAD = struct.Struct("<dB")
"""Time and kind, with which packets and batches begin."""

BATCH = 2
"""The kind of a batch."""

LENGTH = struct.Struct("<H")
"""Of a packet in a batch."""

LONGEST_NAME = 255
"""Bytes of a topic or a type. ROS allows no longer topics."""


class PacketError(ValueError):
    """What a client or gateway sent has not the format."""


class TooLargeError(PacketError):
    """It holds more bytes than are accepted."""


class Packet(NamedTuple):
    """`time` is wall-clock seconds; `payload` is compressed when `is_compressed`."""

    time: float
    is_compressed: bool
    topic: str
    type_name: str
    payload: bytes


def prefix(topic: str, type_name: str) -> bytes:
    """The bytes between head and payload."""
    return f"{topic}\0{type_name}\0".encode()


def pack(packet: Packet) -> bytes:
    return HEAD.pack(packet.time, packet.is_compressed) + prefix(packet.topic, packet.type_name) + packet.payload


def unpack(data: bytes) -> Packet:
    """Parse a packet; the names in it may be anything that is UTF-8. Raises PacketError."""
    if len(data) < HEAD.size:
        raise PacketError(f"{len(data)} bytes are too short for a packet")
    time, kind = HEAD.unpack_from(data)
    if kind > 1:
        raise PacketError(f"the packet has the unknown kind {kind}")
    if not math.isfinite(time):
        raise PacketError(f"the time is not finite: {time}")
    topic, start = _name(data, HEAD.size, "topic")
    type_name, start = _name(data, start, "type")
    return Packet(time, kind == 1, topic, type_name, data[start:])


def _name(data: bytes, start: int, what: str) -> tuple[str, int]:
    """The text that ends with the next NUL, and the index behind that."""
    end = data.find(0, start, start + LONGEST_NAME + 1)
    if end < 0:
        raise PacketError(f"the {what} does not end within {LONGEST_NAME} bytes")
    try:
        return data[start:end].decode(), end + 1
    except UnicodeDecodeError as error:
        raise PacketError(f"the {what} is not UTF-8") from error


# -- batches ----------------------------------------------------------------------------------------------------------


def datagrams(packets: Iterable[bytes], most: int, time: float) -> Iterator[bytes]:
    """The packets in their order, in batches of at most `most` bytes; a packet that fits into none goes alone.

    `time` is wall-clock seconds.
    """
    waiting: list[bytes] = []
    room = most - HEAD.size
    for packet in packets:
        needed = LENGTH.size + len(packet)
        if needed > room:
            yield from _batch(waiting, time)
            waiting, room = [], most - HEAD.size
        if needed > room:
            yield packet
        else:
            waiting.append(packet)
            room -= needed
    yield from _batch(waiting, time)


def _batch(packets: list[bytes], time: float) -> Iterator[bytes]:
    if len(packets) > 1:
        parts = (part for packet in packets for part in (LENGTH.pack(len(packet)), packet))
        yield HEAD.pack(time, BATCH) + b"".join(parts)
    else:
        yield from packets


def unbatched(datagram: bytes) -> list[bytes]:
    """The packets of a datagram, which is a batch or a packet itself. Raises PacketError."""
    if len(datagram) < HEAD.size:
        raise PacketError(f"{len(datagram)} bytes are too short for a packet")
    if datagram[HEAD.size - 1] != BATCH:
        return [datagram]
    packets: list[bytes] = []
    start = HEAD.size
    while start < len(datagram):
        if len(datagram) < start + LENGTH.size:
            raise PacketError("the batch ends within a length")
        [length] = LENGTH.unpack_from(datagram, start)
        start += LENGTH.size
        packet = datagram[start : start + length]
        if len(packet) < length:
            raise PacketError(f"the batch ends within a packet of {length} bytes")
        if length < HEAD.size or packet[HEAD.size - 1] == BATCH:
            raise PacketError("an item of the batch is a batch itself, or too short for a packet")
        packets.append(packet)
        start += length
    return packets


# -- compression ------------------------------------------------------------------------------------------------------

_SMALL = 1 << 16
"""Bytes up to which a compressor is reused: creating one takes three times as long as its work. With longer data it
would keep up to hundreds of megabytes."""

_LEAST_WINDOW_LOG = 23
"""8 MiB, which RFC 8878 (3.1.1.1.2) wants every decoder to support."""

_MAGIC = b"\x28\xb5\x2f\xfd"
"""Of a frame that has content; there are others that are to be skipped."""


class _Compressors(threading.local):
    """By level, one for each thread: a second thread would have to wait for the first."""

    def __init__(self) -> None:
        self.by_level: dict[int, zstd.ZstdCompressor] = {}


_compressors = _Compressors()


def compress(data: bytes, level: int) -> bytes:
    """One zstd frame with the content's size in its header, which some clients need; level 1 to 22."""
    if len(data) > _SMALL:
        return zstd.compress(data, level)
    compressor = _compressors.by_level.get(level)
    if compressor is None:
        compressor = _compressors.by_level[level] = zstd.ZstdCompressor(level)
    frame: bytes = compressor.compress(data, zstd.ZstdCompressor.FLUSH_FRAME)
    return frame


def decompress(data: bytes, most: int) -> bytes:
    """The content of one zstd frame, at most `most` bytes. The frame's window takes no more memory than that, or 8 MiB.

    Raises TooLargeError for more, PacketError for anything else: damage, a second frame, what needs a dictionary.
    """
    if not data.startswith(_MAGIC):
        raise PacketError("the payload is not a zstd frame")
    declared = _declared_size(data)
    if declared > most:
        raise TooLargeError(f"the payload has {declared} bytes uncompressed, more than {most}")
    limit = declared or most
    window = max(_LEAST_WINDOW_LOG, (most - 1).bit_length())
    try:
        decompressor = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: window})
        content: bytes = decompressor.decompress(data, limit + 1)
    except zstd.ZstdError as error:
        raise PacketError(f"the payload cannot be decompressed: {error}") from error
    if len(content) > limit:
        raise TooLargeError(f"the payload exceeds {limit} bytes uncompressed")
    if not decompressor.eof:
        raise PacketError("the payload is a truncated zstd frame")
    if decompressor.unused_data:
        raise PacketError("bytes follow the payload's zstd frame")
    return content


def _declared_size(data: bytes) -> int:
    """The size of a frame's content by its header; 0 where the header does not tell, or is none."""
    try:
        return zstd.get_frame_info(data).decompressed_size or 0
    except zstd.ZstdError:
        return 0

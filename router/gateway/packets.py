"""Packets of a gateway (`gateway_v1`), their compression, and batches of them in one datagram (`gateway_v2`).

A packet is

    float64 LE   seconds since 1970
    uint8        1 when the payload is a zstd frame, else 0
    topic, NUL   UTF-8
    type, NUL    for example `sensor_msgs/msg/Imu`
    payload      to the end; empty requests schemas

and a batch is the time and the kind 2, followed by packets, each preceded by its length (uint16 LE).
"""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from backports import zstd

HEAD = struct.Struct("<dB")
"""Time and kind: the beginning of packets and batches."""

BATCH = 2
"""The kind of a batch."""

LENGTH = struct.Struct("<H")
"""The length of a packet in a batch."""

LONGEST_NAME = 255
"""Maximum bytes of a topic or type; ROS does not allow longer topics."""


class PacketError(ValueError):
    """Data from a client or gateway has the wrong format."""


class TooLargeError(PacketError):
    """The data exceeds a size limit."""


class Packet(NamedTuple):
    """`time` is wall-clock seconds; `payload` is compressed when `is_compressed`."""

    time: float
    is_compressed: bool
    topic: str
    type_name: str
    payload: bytes


def prefix(topic: str, type_name: str) -> bytes:
    """Return the bytes between head and payload."""
    return f"{topic}\0{type_name}\0".encode()


def pack(packet: Packet) -> bytes:
    return HEAD.pack(packet.time, packet.is_compressed) + prefix(packet.topic, packet.type_name) + packet.payload


def unpack(data: bytes) -> Packet:
    """Parse a packet; its names can be any UTF-8. Raises PacketError."""
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
    """Return the text up to the next NUL, and the index after it."""
    end = data.find(0, start, start + LONGEST_NAME + 1)
    if end < 0:
        raise PacketError(f"the {what} does not end within {LONGEST_NAME} bytes")
    try:
        return data[start:end].decode(), end + 1
    except UnicodeDecodeError as error:
        raise PacketError(f"the {what} is not UTF-8") from error


# -- batches ----------------------------------------------------------------------------------------------------------


def datagrams(packets: Iterable[bytes], most: int, time: float) -> Iterator[bytes]:
    """Yield the packets in order, in batches of at most `most` bytes; a packet that fits into none goes alone.

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
    """Return the packets of a datagram: a batch, or one packet. Raises PacketError."""
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
"""Bytes up to which a compressor is reused: creating one takes three times as long as its work. After longer data it
would keep up to hundreds of megabytes."""

_LEAST_WINDOW_LOG = 23
"""8 MiB, which RFC 8878 (3.1.1.1.2) recommends that every decoder supports."""

_MAGIC = b"\x28\xb5\x2f\xfd"
"""The beginning of a frame with content; there are also frames to skip."""


class _Compressors(threading.local):
    """Compressors by level, one per thread: threads cannot share one at the same time."""

    def __init__(self) -> None:
        self.by_level: dict[int, zstd.ZstdCompressor] = {}


_compressors = _Compressors()


def compress(data: bytes, level: int) -> bytes:
    """Return one zstd frame with the content size in its header, which some clients need. `level` is 1 to 22."""
    if len(data) > _SMALL:
        return zstd.compress(data, level)
    compressor = _compressors.by_level.get(level)
    if compressor is None:
        compressor = _compressors.by_level[level] = zstd.ZstdCompressor(level)
    frame: bytes = compressor.compress(data, zstd.ZstdCompressor.FLUSH_FRAME)
    return frame


def decompress(data: bytes, most: int) -> bytes:
    """Return the content of one zstd frame, at most `most` bytes. Its window is limited to that size, or 8 MiB.

    Raises TooLargeError for more; PacketError for damaged data, a second frame, or a frame that needs a dictionary.
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
    """Return the content size in a frame's header; 0 if it is missing or the header is invalid."""
    try:
        return zstd.get_frame_info(data).decompressed_size or 0
    except zstd.ZstdError:
        return 0

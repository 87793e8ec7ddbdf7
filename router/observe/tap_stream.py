"""The stream of a tap: what a router sees, as bytes over HTTP. Knows no connection, and no meaning of a datagram.

It is MAGIC and then records, each behind its length: `<uint32 length> <uint8 kind> ...`, all little-endian.

    SEEN   <uint64 wall clock, ns> <4 bytes IPv4 address> <uint16 port> <uint8 length> <listener> <datagram>
    LOST   <uint64 count>    so many were not sent, because whoever reads the stream is too slow
    ALIVE                    nothing was seen: once a second where there is nothing to send

A datagram longer than the router takes is cut to one byte more than that.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple

from router.errors import TransportError
from router.recording.mirror import Mirrored, MirroredDatagram

MAGIC = b"router tap 1\n"
CONTENT_TYPE = "application/x-router-tap"

SEEN, LOST, ALIVE = 1, 2, 3

_LENGTH = struct.Struct("<I")
_SEEN = struct.Struct("<IBQ")
_LOST = struct.Struct("<IBQ")
_SENDER = struct.Struct("<4sHB")
_LONGEST = 1 << 20


class Lost(NamedTuple):
    """So many were seen and are not in the stream."""

    number: int


def encode(batch: Iterable[Mirrored]) -> bytes:
    """One record for each."""
    pieces: list[bytes] = []
    for at, listener, peer, data in batch:
        sender = _sender(listener, peer)
        pieces += (_SEEN.pack(9 + len(sender) + len(data), SEEN, at), sender, data)
    return b"".join(pieces)


def encode_lost(count: int) -> bytes:
    return _LOST.pack(9, LOST, count)


def encode_alive() -> bytes:
    return _LENGTH.pack(1) + bytes([ALIVE])


@lru_cache(1024)
def _sender(listener: str, peer: tuple[str, int]) -> bytes:
    name = listener.encode()
    return _SENDER.pack(socket.inet_aton(peer[0]), peer[1], len(name)) + name


class StreamReader:
    """Takes the stream apart, in whatever pieces it comes."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self._has_begun = False

    def take(self, piece: bytes) -> Iterator[MirroredDatagram | Lost]:
        """What is complete with this piece. Raises TransportError for what is no stream of a tap."""
        waiting = self._waiting
        waiting += piece
        if not self._has_begun:
            if len(waiting) < len(MAGIC):
                return
            if not waiting.startswith(MAGIC):
                raise TransportError(f"this is no stream of a tap, or of another version: {bytes(waiting[:20])!r}")
            self._has_begun = True
            del waiting[: len(MAGIC)]
        start = 0
        while len(waiting) - start >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(waiting, start)
            end = start + _LENGTH.size + length
            if not 0 < length <= _LONGEST:
                raise TransportError(f"the stream of a tap is broken: a record of {length} bytes")
            if len(waiting) < end:
                break
            yield from _record(bytes(waiting[start + _LENGTH.size : end]))
            start = end
        del waiting[:start]


def _record(record: bytes) -> Iterator[MirroredDatagram | Lost]:
    """Kinds that are not known are left out: a newer router may have more to say."""
    if record[0] == LOST:
        yield Lost(int.from_bytes(record[1:9], "little"))
    elif record[0] == SEEN:
        host, port, length = _SENDER.unpack_from(record, 9)
        data = 9 + _SENDER.size + length
        listener = record[9 + _SENDER.size : data].decode()
        yield MirroredDatagram(
            int.from_bytes(record[1:9], "little"), listener, (socket.inet_ntoa(host), port), record[data:]
        )

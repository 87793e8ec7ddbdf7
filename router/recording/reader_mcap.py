"""A recording as it is read: the datagrams, byte for byte, in the order in which the router took them.

Knows the MCAP format and what the recorder's channels mean; knows no table. Of a file whose writer was killed it reads
all that was written whole.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from google.protobuf.message import DecodeError as ProtobufError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from router.engine.slow_path import LEN
from router.errors import UsageError
from router.recording.channels import Holds, varint
from router.recording.chunk import HEAD
from router.recording.file import LIBRARY, METADATA
from router.recording.schemas import Datagram

Peer = tuple[str, int]

_RECORD = struct.Struct("<BQ")
_DAMAGED = (McapError, zstandard.ZstdError, ProtobufError, struct.error, LookupError, ValueError, RuntimeError)
"""What reading raises for what no recorder wrote; lz4, which `mcap recover` may have used, a RuntimeError."""


class Recorded(NamedTuple):
    """A datagram: when the router took it by the wall clock and by one that nobody set (ns), where, from whom.

    `endpoint` is what the table of that time called the sender, empty for a stranger.
    """

    at: int
    steady: int
    listener: str
    peer: Peer
    endpoint: str
    data: bytes


class Recording:
    """`about` says what was recorded and why. Raises UsageError for what is no recording of a router."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.is_whole = self.ends_early = False
        """Once all was read: the writer ended it in good order, or was killed, or the file is damaged."""
        self._senders: dict[int, Callable[[bytes], tuple[str, Peer, str, bytes] | None]] = {}
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from error
        self.size = path.stat().st_size
        try:
            self._begin()
        except UsageError:
            self.close()
            raise

    @property
    def position(self) -> int:
        """Bytes of `size` that have been read."""
        return self._file.tell()

    def close(self) -> None:
        self._file.close()

    def datagrams(self) -> Iterator[Recorded]:
        """To be asked for once. Ends where the file does, or where it is damaged."""
        try:
            for opcode, body in self._records():
                yield from self._in_record(opcode, body)
                self.is_whole = opcode == Opcode.FOOTER
        except _DAMAGED:
            pass
        self.ends_early = not self.is_whole

    def _in_record(self, opcode: int, body: bytes) -> Iterator[Recorded]:
        if opcode == Opcode.CHUNK:
            unpacked, length = get_chunk_data_stream(Chunk.read(_stream(body)), validate_crc=True)
            yield from self._messages(unpacked.read(length))
        elif opcode == Opcode.CHANNEL:
            self._know(Channel.read(_stream(body)))
        elif opcode == Opcode.METADATA and (metadata := Metadata.read(_stream(body))).name == METADATA:
            self.about = metadata.metadata

    def _begin(self) -> None:
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise UsageError(f"{self.path} is no MCAP file")
        opcode, body = next(self._records(), (None, b""))
        if opcode != Opcode.HEADER or not Header.read(_stream(body)).library.startswith(LIBRARY):
            raise UsageError(f"{self.path} was not recorded by a router")

    def _records(self) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of each record that is there whole."""
        while len(head := self._file.read(_RECORD.size)) == _RECORD.size:
            opcode, length = _RECORD.unpack(head)
            if opcode == 0 or length > self.size - self._file.tell():  # zeros are what is left of a loss of power
                return
            yield opcode, self._file.read(length)

    def _messages(self, data: bytes) -> Iterator[Recorded]:
        """Those of a chunk. Other programs that write MCAP put channels into chunks as well."""
        start, end, unpack = 0, len(data), HEAD.unpack_from
        while start < end:
            opcode, length = _RECORD.unpack_from(data, start)
            behind = start + _RECORD.size + length
            if opcode == Opcode.MESSAGE:
                _, _, channel, _, at, steady = unpack(data, start)
                if found := self._senders[channel](data[start + HEAD.size : behind]):
                    listener, peer, endpoint, datagram = found
                    yield Recorded(at, steady, listener, peer, endpoint, datagram)
            elif opcode == Opcode.CHANNEL:
                self._know(Channel.read(_stream(data[start + _RECORD.size : behind])))
            start = behind

    def _know(self, channel: Channel) -> None:
        told = channel.metadata
        holds = told.get("holds")
        if holds == Holds.PAYLOAD.value:
            self._senders[channel.id] = _rebuilt(int(told["number"]), told["listener"], told["peer"], told["endpoint"])
        else:
            self._senders[channel.id] = _raw if holds == Holds.DATAGRAM.value else _nothing


def _rebuilt(number: int, listener: str, peer: str, endpoint: str) -> Callable[[bytes], tuple[str, Peer, str, bytes]]:
    """What makes a datagram of its payload, as protobuf encodes an envelope."""
    tag, sender = varint(number << 3 | LEN), _peer(peer)
    return lambda payload: (listener, sender, endpoint, tag + varint(len(payload)) + payload)


def _raw(message: bytes) -> tuple[str, Peer, str, bytes]:
    datagram: Any = Datagram.FromString(message)
    return datagram.listener, _peer(datagram.peer), datagram.endpoint, datagram.data


def _nothing(_: bytes) -> None:
    """Of a payload whose datagram is elsewhere in the recording."""


def _peer(text: str) -> Peer:
    host, _, port = text.rpartition(":")
    return host, int(port)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))

"""Reads a recording: the datagrams, byte for byte, in the order in which the router took them.

Of a file whose writer was killed it reads all chunks that were written whole.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from google.protobuf.message import DecodeError as ProtobufError
from mcap.exceptions import McapError
from mcap.records import Channel, Footer, Header, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader

from router.datagrams import Peer
from router.errors import UsageError
from router.recording.channels import Datagram, Holds
from router.recording.writer import LIBRARY, METADATA
from router.types.wire import LEN, varint

_DAMAGED = (McapError, zstandard.ZstdError, ProtobufError, struct.error, LookupError, ValueError, RuntimeError)
"""What reading raises for what no recorder wrote; lz4, which `mcap recover` may have used, a RuntimeError."""


class Recorded(NamedTuple):
    """A datagram: when the router took it by the wall clock and by one that nobody set (ns), where, from whom.

    `endpoint` is what the table of that time called the sender, empty for a stranger. `reason` is why no route took the
    datagram, empty if one did.
    """

    at: int
    steady: int
    listener: str
    peer: Peer
    endpoint: str
    reason: str
    data: bytes


class Recording:
    """`about` says what was recorded and why. Raises UsageError for a file that is no recording of a router."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.is_whole = self.ends_early = False
        """Once all was read: the writer finished the file; it was killed, or the file is damaged."""
        self._decoders: dict[int, Callable[[bytes], tuple[str, Peer, str, str, bytes] | None]] = {}
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from error
        self.size = path.stat().st_size
        self._records = StreamReader(self._file, validate_crcs=True, record_size_limit=self.size).records
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
        """Yield each datagram, once, until the file ends or is damaged."""
        try:
            for record in self._records:
                if isinstance(record, Message):
                    if (found := self._decoders[record.channel_id](record.data)) is not None:
                        yield Recorded(record.log_time, record.publish_time, *found)
                else:
                    self._take(record)
        except _DAMAGED:
            pass
        self.ends_early = not self.is_whole

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Channel):
            self._decoders[record.id] = _decoder(record.metadata)
        elif isinstance(record, Metadata) and record.name == METADATA:
            self.about = record.metadata
        elif isinstance(record, Footer):
            self.is_whole = True

    def _begin(self) -> None:
        try:
            header = next(self._records)
        except _DAMAGED:
            raise UsageError(f"{self.path} is not an MCAP file") from None
        if not isinstance(header, Header) or not header.library.startswith(LIBRARY):
            raise UsageError(f"{self.path} is not a recording of a router")


def _decoder(metadata: dict[str, str]) -> Callable[[bytes], tuple[str, Peer, str, str, bytes] | None]:
    """Return what makes a datagram of a message of the channel with this metadata: the fields of Recorded from
    `listener` on."""
    holds, reason = metadata.get("holds"), metadata.get("reason", "")
    if holds == Holds.DATAGRAM.value:
        return partial(_raw, reason)
    if holds != Holds.PAYLOAD.value:
        return lambda _: None  # the datagram is elsewhere in the recording
    tag, peer = varint(int(metadata["number"]) << 3 | LEN), _peer(metadata["peer"])
    listener, endpoint = metadata["listener"], metadata["endpoint"]
    return lambda payload: (listener, peer, endpoint, reason, b"".join((tag, varint(len(payload)), payload)))


def _raw(reason: str, message: bytes) -> tuple[str, Peer, str, str, bytes]:
    datagram: Any = Datagram.FromString(message)
    return datagram.listener, _peer(datagram.peer), datagram.endpoint, reason, datagram.data


def _peer(text: str) -> Peer:
    host, _, port = text.rpartition(":")
    return host, int(port)

"""Reads a recording: the datagrams, byte for byte, in the order in which the router received them.

If the writer was killed, it reads all complete chunks of the file.
"""

from __future__ import annotations

import os
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
"""Errors in files that no recorder wrote; lz4, which `mcap recover` may have used, raises RuntimeError."""


class Recorded(NamedTuple):
    """A datagram, with its time of reception (ns): `at` by the wall clock, `steady` without steps of that clock.

    `endpoint` is the sender's name in the table that ran then, "" for a stranger. `reason` is why no route accepted the
    datagram, "" if one did.
    """

    at: int
    steady: int
    listener: str
    peer: Peer
    endpoint: str
    reason: str
    data: bytes


class Recording:
    """A recording. `about` is its metadata. Raises UsageError if the file is not a recording of a router."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.is_whole = self.ends_early = False
        """Set when all is read: the writer finished the file; or it was killed, or the file is damaged."""
        self._decoders: dict[int, Callable[[bytes], tuple[str, Peer, str, str, bytes] | None]] = {}
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size  # the file may be removed meanwhile
        self._records = StreamReader(self._file, validate_crcs=True, record_size_limit=self.size).records
        try:
            self._begin()
        except UsageError:
            self.close()
            raise

    @property
    def position(self) -> int:
        """The number of bytes read, out of `size`."""
        return self._file.tell()

    def close(self) -> None:
        self._file.close()

    def datagrams(self) -> Iterator[Recorded]:
        """Yield each datagram once, until the end of the file or damage."""
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
    """Return a function that decodes the messages of the channel with this metadata.

    It returns the fields of Recorded from `listener` on, or None if the datagram is elsewhere in the recording.
    """
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

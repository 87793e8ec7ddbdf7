"""Reads a recording: the datagrams, byte for byte, in the order in which the router received them, and its actions.

If the writer was killed, it reads all complete chunks of the file. Other tools may have rewritten the file: they put
their own name into the header, and may move the metadata behind the messages or leave it out.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from google.protobuf.message import DecodeError as ProtobufError
from mcap.exceptions import McapError
from mcap.records import Channel, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from router.datagrams import Peer
from router.errors import UsageError, did_you_mean_file
from router.recording.beside import beside_in
from router.recording.channels import Datagram, Event, Holds
from router.recording.mirror import Action
from router.recording.schemas import RecordedCase, RecordedTypes, wrapping_of
from router.recording.writer import METADATA
from router.types.case_by import Wrapping
from router.types.wire import varint

_DAMAGED = (McapError, zstandard.ZstdError, ProtobufError, struct.error, LookupError, ValueError, RuntimeError)
"""Errors in files that no recorder wrote; lz4, which `mcap recover` may have used, raises RuntimeError."""
_OURS = frozenset(held.value for held in Holds)
_WHOLE = (Holds.DATAGRAM.value, Holds.EVENT.value)


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


class RecordedAction(NamedTuple):
    """What the router did by itself. `steady` is as for a datagram.

    The datagram of the action is encoded as protobuf encodes it, and has the trailing zeros that were not sent.
    """

    steady: int
    action: Action

    @property
    def at(self) -> int:
        return self.action.at


_Decoded = tuple[str, Peer, str, str, bytes]
"""The fields of Recorded from `listener` on."""
_Decoder = Callable[[int, bytes], "_Decoded | Action | None"]
"""Decodes a message that was logged at a time. Returns None if it is also elsewhere in the recording."""


class Recording:
    """A recording. `about` is its metadata, empty if a tool left it out.

    Raises UsageError if the file is not a recording of a router: it has neither the metadata nor a channel of one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.is_whole = self.ends_early = False
        """Set when all is read: the writer finished the file; or it was killed, or the file is damaged."""
        self._decoders: dict[int, _Decoder] = {}
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            hint = did_you_mean_file(str(path), path) if isinstance(error, FileNotFoundError) else ""
            if isinstance(error, FileNotFoundError) and not path.is_absolute():
                hint = hint or f"paths are relative to the working directory, {Path.cwd()}"
            raise UsageError(f"{path}: {error.strerror}", hint) from error
        self.size = os.fstat(self._file.fileno()).st_size  # the file may be removed meanwhile
        try:
            self._find_metadata()
        except UsageError:
            self.close()
            raise
        self._file.seek(0)
        self._records = StreamReader(self._file, validate_crcs=True, record_size_limit=self.size).records

    @property
    def position(self) -> int:
        """The number of bytes read, out of `size`."""
        return self._file.tell()

    def close(self) -> None:
        self._file.close()

    def datagrams(self) -> Iterator[Recorded]:
        """Yield each datagram once, until the end of the file or damage."""
        return (record for record in self.everything() if isinstance(record, Recorded))

    def everything(self) -> Iterator[Recorded | RecordedAction]:
        """Yield each datagram and each action once, until the end of the file or damage.

        Actions are up to 0.3 s out of order.
        """
        try:
            for record in self._records:
                if not isinstance(record, Message):
                    self._take(record)
                elif (decoded := self._decoders[record.channel_id](record.log_time, record.data)) is None:
                    continue
                elif isinstance(decoded, Action):
                    yield RecordedAction(record.publish_time, decoded)
                else:
                    yield Recorded(record.log_time, record.publish_time, *decoded)
        except _DAMAGED:
            pass
        self.ends_early = not self.is_whole

    def types(self) -> RecordedTypes:
        """Return what all channels declare. Chunks are skipped if there is an index. Call this before reading
        messages.
        """
        found = self._types(emit_chunks=True)
        return found if found.cases or found.beside else self._types(emit_chunks=False)

    def _types(self, *, emit_chunks: bool) -> RecordedTypes:
        """Return what the channels outside chunks declare, or all channels."""
        with self.path.open("rb") as file:
            schemas: dict[int, Schema] = {}
            cases: dict[tuple[str, Wrapping], RecordedCase] = {}
            beside: dict[str, bytes] = {}
            try:
                for record in StreamReader(file, emit_chunks=emit_chunks, record_size_limit=self.size).records:
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        schema, label = schemas[record.schema_id], record.metadata.get("envelope", "")
                        if "number" in record.metadata:
                            case, around = record.topic.rpartition("/")[2], wrapping_of(record.metadata)
                            made = RecordedCase(case, around, schema.name, schema.data, label)
                            cases.setdefault((case, around), made)
                        elif record.metadata.get("holds") in _WHOLE and beside_in(schema.data) is not None:
                            beside.setdefault(label, schema.data)
            except _DAMAGED:
                pass
        return RecordedTypes([*cases.values()], beside)

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Channel):
            self._decoders[record.id] = _decoder(record.metadata)
        elif isinstance(record, Footer):
            self.is_whole = True

    def _find_metadata(self) -> None:
        """Read up to the metadata, which the router writes first. Chunks are skipped."""
        is_mcap = is_recording = False
        try:
            for record in StreamReader(self._file, emit_chunks=True, record_size_limit=self.size).records:
                is_mcap = True
                if isinstance(record, Metadata) and record.name == METADATA:
                    self.about = record.metadata
                    return
                is_recording |= isinstance(record, Channel) and record.metadata.get("holds") in _OURS
        except _DAMAGED:
            pass
        if not is_recording:
            raise UsageError(f"{self.path} is not {'a recording of a router' if is_mcap else 'an MCAP file'}")


def _decoder(metadata: dict[str, str]) -> _Decoder:
    """Return a function that decodes the messages of the channel with this metadata."""
    holds, reason = metadata.get("holds"), metadata.get("reason", "")
    if holds == Holds.DATAGRAM.value:
        return partial(_raw, reason)
    if holds == Holds.EVENT.value:
        return _event
    if holds == Holds.SENT.value:
        rebuilt = _rebuild(metadata)
        what, route, target, topic = (metadata[key] for key in ("what", "route", "endpoint", "ros"))
        return lambda at, payload: Action(at, what, route, target, topic, data=rebuilt(payload))
    if holds != Holds.PAYLOAD.value:
        return lambda *_: None  # the datagram is elsewhere in the recording
    rebuilt, peer = _rebuild(metadata), _peer(metadata["peer"])
    listener, endpoint = metadata["listener"], metadata["endpoint"]
    return lambda _, payload: (listener, peer, endpoint, reason, rebuilt(payload))


def _rebuild(metadata: Mapping[str, str]) -> Callable[[bytes], bytes]:
    """Return a function that puts a payload into an envelope, as the metadata of its channel say."""
    around = wrapping_of(metadata)
    if not around.tag:
        return lambda payload: payload
    before = around.before + varint(around.tag)
    return lambda payload: b"".join((before, varint(len(payload)), payload, around.after))


def _raw(reason: str, _: int, message: bytes) -> _Decoded:
    datagram: Any = Datagram.FromString(message)
    return datagram.listener, _peer(datagram.peer), datagram.endpoint, reason, datagram.data


def _event(at: int, message: bytes) -> Action:
    event: Any = Event.FromString(message)
    return Action(at, event.what, event.route, event.endpoint, event.ros, event.reason, event.detail, event.data)


def _peer(text: str) -> Peer:
    host, _, port = text.rpartition(":")
    return host.removeprefix("[").removesuffix("]"), int(port)

"""Mirrored datagrams and actions of the carrier, in the form that observers get."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

from router.carrier.ring import Ring
from router.compiler.refusals import DROP_REASON_NAMES, REJECTIONS, why_refused
from router.datagrams import Peer
from router.declared import NO_NAME, ROUTED, Action, ActionRecord, MirrorRecord
from router.image.names import Names
from router.net.addresses import host_text

T = TypeVar("T")

_FIELDS: Any = MirrorRecord._fields_
_HEAD = struct.Struct("".join(kind._type_ for _, kind in _FIELDS))  # much faster than MirrorRecord
_SIZE = struct.Struct("I")
_ACTION_HEAD = ctypes.sizeof(ActionRecord)


class Taken(Generic[T]):
    """Records that were taken from a ring. `decode` decodes them when they are read, also after a reload."""

    def __init__(self, records: bytes, decode: Callable[[bytes], Iterator[T]]) -> None:
        self.records = records
        self.decode = decode

    def __len__(self) -> int:
        """Return the number of records; takes time for each."""
        number = position = 0
        while position < len(self.records):
            position += _SIZE.unpack_from(self.records, position)[0]
            number += 1
        return number

    def __iter__(self) -> Iterator[T]:
        return self.decode(self.records)


class MirrorRing:
    """Reads `ring`, to which the receive thread writes while there are observers."""

    def __init__(self, ring: Ring, names: Names) -> None:
        self.ring = ring
        self._name = names.name

    def take(self) -> Taken[tuple[int, str, Peer, str, str, bytes]]:
        """Return the datagrams received since the last call, as `recording.mirror.Mirrored`. Not thread-safe."""
        return Taken(_all_of(self.ring), self._decode)

    def _decode(self, records: bytes) -> Iterator[tuple[int, str, Peer, str, str, bytes]]:
        name, position = self._name, 0
        while position < len(records):
            size, listener, at, address, port, length, reason, endpoint, _ = _HEAD.unpack_from(records, position)
            data = records[position + _HEAD.size : position + _HEAD.size + length]
            sender = name(endpoint) if endpoint >= 0 else ""
            why = REJECTIONS[reason] if reason != ROUTED else ""
            yield at, name(listener), (host_text(address), port), sender, why, data
            position += size


class ActionRing:
    """Reads `ring`, to which all threads note their actions while there are observers."""

    def __init__(self, ring: Ring, names: Names) -> None:
        self.ring = ring
        self._name = names.name

    def take(self) -> Taken[tuple[int, str, str, str, str, str, str, bytes]]:
        """Return the actions since the last call, with the fields of `recording.mirror.Action`. Not thread-safe."""
        return Taken(_all_of(self.ring), self._decode)

    def _decode(self, records: bytes) -> Iterator[tuple[int, str, str, str, str, str, str, bytes]]:
        position = 0
        while position < len(records):
            it = ActionRecord.from_buffer_copy(records, position)
            rest = records[position + _ACTION_HEAD : position + _ACTION_HEAD + it.length]
            reason, detail, data = self._outcome(it, rest)
            target, topic = self._name_or_none(it.target), self._name_or_none(it.topic)
            what = Action(it.action).name.lower()
            yield it.at, what, self._name_or_none(it.route), target, topic, reason, detail, data
            position += it.size

    def _name_or_none(self, number: int) -> str:
        return self._name(number) if number != NO_NAME else ""

    def _outcome(self, it: ActionRecord, rest: bytes) -> tuple[str, str, bytes]:
        """Return why the datagram was not sent, with details (of a return: its silence), and the datagram."""
        if it.action == Action.RETURNED:
            return "", f"{int.from_bytes(rest, sys.byteorder) / 1e9:.1f} s", b""
        error = os.strerror(it.error) if it.error else ""
        if it.action != Action.LOST:
            return "send_error" if error else "", error, rest
        detail = why_refused(it.refusal, rest) if it.refusal.kind else rest.decode(errors="replace")
        return DROP_REASON_NAMES[it.reason], detail or error, b""


def _all_of(ring: Ring) -> bytes:
    pieces = []
    while records := ring.take():
        pieces.append(bytes(records))
    return b"".join(pieces)

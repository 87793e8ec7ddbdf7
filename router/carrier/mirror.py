"""Mirrored datagrams and actions of the carrier, in the form that observers get."""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from socket import inet_ntoa

from router.carrier.reasons import DROP_REASON_NAMES, REJECTIONS
from router.carrier.ring import Ring
from router.compiler.refusals import why_refused
from router.datagrams import Peer
from router.declared import NO_NAME, ROUTED, Action, ActionRecord, MirrorRecord
from router.image.names import Names

_HEAD, _ACTION_HEAD = ctypes.sizeof(MirrorRecord), ctypes.sizeof(ActionRecord)


class MirrorRing:
    """Reads `ring`, to which the receive thread writes while there are observers."""

    def __init__(self, ring: Ring, names: Names) -> None:
        self.ring = ring
        self._name = names.name

    def take(self) -> list[tuple[int, str, Peer, str, str, bytes]]:
        """Return the datagrams received since the last call, as `recording.mirror.Mirrored`. Not thread-safe."""
        taken: list[tuple[int, str, Peer, str, str, bytes]] = []
        while records := self.ring.take():
            position = 0
            while position < len(records):
                it = MirrorRecord.from_buffer(records, position)
                data = bytes(records[position + _HEAD : position + _HEAD + it.length])
                sender = self._name(it.endpoint) if it.endpoint >= 0 else ""
                why = REJECTIONS[it.reason] if it.reason != ROUTED else ""
                taken.append((it.at, self._name(it.listener), (_host(it.address), it.port), sender, why, data))
                position += it.size
        return taken


class ActionRing:
    """Reads `ring`, to which all threads note their actions while there are observers."""

    def __init__(self, ring: Ring, names: Names) -> None:
        self.ring = ring
        self._name = names.name

    def take(self) -> list[tuple[int, str, str, str, str, str, str, bytes]]:
        """Return the actions since the last call, with the fields of `recording.mirror.Action`. Not thread-safe."""
        taken: list[tuple[int, str, str, str, str, str, str, bytes]] = []
        while records := self.ring.take():
            position = 0
            while position < len(records):
                it = ActionRecord.from_buffer(records, position)
                rest = bytes(records[position + _ACTION_HEAD : position + _ACTION_HEAD + it.length])
                reason, detail, data = self._outcome(it, rest)
                target, topic = self._name_or_none(it.target), self._name_or_none(it.topic)
                what = Action(it.action).name.lower()
                taken.append((it.at, what, self._name_or_none(it.route), target, topic, reason, detail, data))
                position += it.size
        return taken

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


@cache
def _host(address: int) -> str:
    return inet_ntoa(address.to_bytes(4, "big"))

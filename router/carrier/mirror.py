"""Mirrored datagrams of the carrier, in the form that observers get."""

from __future__ import annotations

import ctypes
from functools import cache
from socket import inet_ntoa

from router.carrier.names import Names
from router.carrier.reasons import REJECTIONS
from router.carrier.ring import Ring
from router.datagrams import Peer
from router.declared import ROUTED, MirrorRecord

_HEAD = ctypes.sizeof(MirrorRecord)


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


@cache
def _host(address: int) -> str:
    return inet_ntoa(address.to_bytes(4, "big"))

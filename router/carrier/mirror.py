"""What the carrier shows of received datagrams, in the form in which observers get it."""

from __future__ import annotations

from functools import cache
from socket import inet_ntoa
from struct import Struct

from router.carrier.outlets import Names
from router.carrier.ring import Ring
from router.compiler.metrics import REJECT_REASONS
from router.datagrams import Peer

_RECORD = Struct("@IIqIIIiiI")
"""`struct mirror_record`."""

_REASONS = (*REJECT_REASONS, "")
"""By `enum reason`; the last one is also ROUTED, -1."""


class MirrorRing:
    """Reads `ring`, which the receive thread writes while somebody observes."""

    def __init__(self, ring: Ring, names: Names) -> None:
        self.ring = ring
        self._name = names.name

    def take(self) -> list[tuple[int, str, Peer, str, str, bytes]]:
        """Return what was received since the last call, as `recording.mirror.Mirrored`. For one thread."""
        taken: list[tuple[int, str, Peer, str, str, bytes]] = []
        head = _RECORD.size
        while records := self.ring.take():
            position = 0
            while position < len(records):
                size, listener, at, address, port, length, why, who, _ = _RECORD.unpack_from(records, position)
                data = bytes(records[position + head : position + head + length])
                sender = self._name(who) if who >= 0 else ""
                taken.append((at, self._name(listener), (_host(address), port), sender, _REASONS[why], data))
                position += size
        return taken


@cache
def _host(address: int) -> str:
    return inet_ntoa(address.to_bytes(4, "big"))

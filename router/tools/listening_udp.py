"""A UDP port on which a gateway sends, and from which schemas can be asked for."""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from router.edges.udp import SO_MEMINFO, SO_RCVBUFFORCE
from router.gateway.packets import Packet, pack
from router.table.model import Address
from router.table.units import LARGEST_DATAGRAM
from router.tools import places
from router.tools.listening import Arrival

_RECEIVE_BUFFER = 4 << 20
"""Bytes that the kernel is asked to keep while we are busy; it may grant less."""

_MOST_AT_ONCE = 1000

_MEMINFO = struct.Struct("9I")
_DROPS = 8


class UdpSource:
    """Bound to `address`. `gateway` is where schemas are asked for, if they are. Raises UsageError."""

    def __init__(self, address: Address, gateway: Address | None, say: Callable[[str], None]) -> None:
        self._socket = places.open_udp(address, "listen")
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        with suppress(PermissionError):  # root gets all of it
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, _RECEIVE_BUFFER)
        self._gateway = gateway
        self._say = say
        self.place = f"udp {Address(*self._socket.getsockname())}"

    @property
    def lost(self) -> int:
        """Datagrams that the kernel threw away because we were too slow."""
        words = _MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size))
        return int(words[_DROPS])

    def ask(self) -> None:
        """An empty packet without a type asks for all schemas. It comes from the port that they are to be sent to."""
        if self._gateway is None:
            return
        request = Packet(time.time(), is_compressed=False, topic="", type_name="", payload=b"")
        try:
            self._socket.sendto(pack(request), self._gateway)
        except OSError as error:
            self._say(f"cannot ask {self._gateway}: {error.strerror}")

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        """All that is there at once: a large message comes as more datagrams than the kernel keeps."""
        found: list[Arrival] = []
        if select.select([self._socket], [], [], timeout)[0]:
            with suppress(BlockingIOError):
                while len(found) < _MOST_AT_ONCE:
                    found.append(Arrival(*self._socket.recvfrom(LARGEST_DATAGRAM)))
        return found

    def close(self) -> None:
        self._socket.close()

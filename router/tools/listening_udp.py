"""A UDP port on which a gateway sends, and from which schemas can be asked for."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from router.gateway.packets import Packet, pack
from router.net.kernel import ask_for_receive_buffer, drops
from router.table.addresses import Address
from router.table.units import LARGEST_DATAGRAM
from router.tools import places
from router.tools.listening import Arrival

_RECEIVE_BUFFER = 4 << 20
"""Bytes that the kernel is asked to keep while we are busy; it may grant less."""

_MOST_AT_ONCE = 1000


class UdpSource:
    """Bound to `address`. `gateway` is where schemas are asked for, if they are. Raises UsageError."""

    def __init__(self, address: Address, gateway: Address | None, say: Callable[[str], None]) -> None:
        self._socket = places.open_udp(address, "listen")
        ask_for_receive_buffer(self._socket, _RECEIVE_BUFFER)
        self._gateway = gateway
        self._say = say
        self.place = f"udp {Address(*self._socket.getsockname())}"

    @property
    def lost(self) -> int:
        """Datagrams that the kernel threw away because we were too slow."""
        return drops(self._socket)

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

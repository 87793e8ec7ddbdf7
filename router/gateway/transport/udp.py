"""A gateway's UDP socket: sends to one client, and receives from that client's host.

The socket is not connected, so that a client can send from any port; it therefore gets no ICMP errors.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress

from router.gateway.transport.base import LOW_WATER, PER_TURN, Client, Events, Frame
from router.gateway.transport.binding import Binding
from router.hosts import any_of, zone
from router.net.addresses import bound_address, interface_index, socket_address
from router.net.kernel import allow_fragments, arrivals, ask_for_receive_buffer, drops
from router.net.sockets import open_udp
from router.table.addresses import Address
from router.table.units import LARGEST_DATAGRAM

SEND_BUFFER = 4 << 20
"""Bytes of the send buffer, for a busy network."""

RECEIVE_BUFFER = 1 << 20
"""Bytes of the receive buffer, for a busy loop."""

BURST = 64
BURST_BYTES = 128 * 1024
PAUSE_SECONDS = 0.001
"""Datagrams and bytes sent at once, and the pause after them: a receiver with a default buffer keeps up."""


class UdpTransport:
    """UDP. Has one client, from the start. Without `local`, it sends from any port and receives nothing."""

    def __init__(self, remote: Address, local: Address | None, events: Events) -> None:
        self.address: Address | None = None
        self._remote = remote
        self._host, _, self._zone = remote.host.partition("%")
        self._local = local
        self._events = events
        self._binding = Binding("udp", local or Address(any_of(remote.host), 0), self._bind)
        self._client: UdpClient | None = None
        self._socket: socket.socket | None = None
        self._drops_at_close = 0

    async def open(self) -> None:
        await self._binding.open()

    async def close(self) -> None:
        await self._binding.close()
        if self._socket is None or self._client is None:
            return
        if self._local is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
        self._client.close()
        self._drops_at_close = self.kernel_drops()
        self._socket.close()
        self._socket = None

    def kernel_drops(self) -> int:
        """Return how many datagrams, from any sender, the kernel has dropped. Thread-safe."""
        if (opened := self._socket) is not None:
            with suppress(OSError):  # it was closed meanwhile
                return drops(opened)
        return self._drops_at_close

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        for client in clients:
            client.write(frames)

    async def _bind(self) -> None:
        opened = open_udp(self._remote.host)
        opened.setblocking(False)
        try:
            # Never SO_REUSEADDR: with it, a second router would steal the port unnoticed.
            opened.bind(socket_address(*self._local or (any_of(self._remote.host), 0)))
            allow_fragments(opened)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            if self._local is not None:
                ask_for_receive_buffer(opened, RECEIVE_BUFFER)
                self._arrived_at = arrivals(opened)
        except OSError:
            opened.close()
            raise
        self._socket = opened
        self.address = Address(*bound_address(opened))
        self._client = UdpClient(opened, self._remote, self._events)
        if self._local is not None:
            asyncio.get_running_loop().add_reader(opened, self._receive, opened, self._client)
        self._events.joined(self._client)

    def _receive(self, opened: socket.socket, client: UdpClient) -> None:
        for _ in range(PER_TURN):
            try:
                data, sender = opened.recvfrom(LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                self._events.failed(client, error, 0)
                return
            if sender[0] != self._host or (self._zone and sender[3] != interface_index(self._zone)):
                self._events.refused("source_mismatch")
            else:
                self._events.received(client, data, self._arrived_at())


class UdpClient:
    """The receiver at the remote address. Each frame is one datagram; bursts are paced."""

    def __init__(self, opened: socket.socket, remote: Address, events: Events) -> None:
        self.label = str(remote)
        self._send = opened.sendto
        self._remote = remote
        self._to = None if zone(remote.host) else socket_address(*remote)
        self._events = events
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[bytes] = deque()
        self._backlog = 0
        self._is_open = True
        self._resume: asyncio.TimerHandle | None = None
        self._burst_ends = 0.0  # by the loop's clock
        self._burst = 0
        self._burst_bytes = 0

    def write(self, frames: Sequence[Frame]) -> None:
        if not self._is_open:
            return
        self._waiting.extend(frame.data for frame in frames)
        self._backlog += sum(len(frame.data) for frame in frames)
        if self._resume is None:
            self._send_burst()

    def backlog(self) -> int:
        return self._backlog

    def close(self) -> None:
        if not self._is_open:
            return
        self._is_open = False
        self._waiting.clear()
        self._backlog = 0
        if self._resume is not None:
            self._resume.cancel()
        self._events.left(self)

    def _send_burst(self) -> None:
        """Send as much as a burst allows now, and the rest later. Of several errors in a burst, report the last."""
        has_waited, self._resume = self._resume is not None, None
        now = self._loop.time()
        if now >= self._burst_ends:
            self._burst_ends = now + PAUSE_SECONDS
            self._burst = self._burst_bytes = 0
        lost = 0
        failure: OSError | None = None
        while self._waiting and self._burst < BURST and self._burst_bytes < BURST_BYTES:
            data = self._waiting.popleft()
            self._backlog -= len(data)
            self._burst += 1
            self._burst_bytes += len(data)
            try:
                self._send(data, self._to or socket_address(*self._remote))
            except OSError as error:
                failure, lost = error, lost + 1
                if isinstance(error, BlockingIOError):  # the network is slower than this burst
                    self._burst = BURST
        if self._waiting:
            self._resume = self._loop.call_at(self._burst_ends, self._send_burst)
        if failure is not None:
            self._events.failed(self, failure, lost)
        if has_waited and self._backlog < LOW_WATER:
            self._loop.call_soon(self._report_drained)

    def _report_drained(self) -> None:
        if self._is_open:
            self._events.drained(self)

"""One websocket of a gateway: when what it brings arrived, how much of it is unfinished, and when it takes no more."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES
from websockets.frames import Frame as Part
from websockets.protocol import Event, State

from router.gateway.transport.arrival import Arrivals
from router.gateway.transport.base import HIGH_WATER
from router.gateway.transport.outflow import Outflow, label, prepare
from router.gateway.transport.stream import StreamClient

if TYPE_CHECKING:
    from router.gateway.transport.websocket import WebsocketTransport

READ_AT_ONCE = 4 * 1024
"""Bytes of a client that are read before other work of the loop has its turn."""

PART_BYTES = 300
"""What each part of a message that is not whole takes up beside its bytes."""


class WebsocketClient(StreamClient):
    def __init__(self, connection: WebsocketConnection) -> None:
        owner = connection.owner
        self.encode = owner.encode
        self.label = label(connection.transport)
        self.outflow = Outflow(connection.transport, owner.feeder, self._is_open, lambda: owner.ears.drained(self))
        self._connection = connection

    def close(self) -> None:
        self._connection.transport.abort()

    def _is_open(self) -> bool:
        """After the closing handshake has begun, nothing may be sent."""
        return self._connection.protocol.state is State.OPEN


class WebsocketConnection(ServerConnection):
    """The library's, which also tells its client when the kernel takes no more, and when it does again."""

    owner: WebsocketTransport
    client: WebsocketClient

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        # What asyncio reads at once, the library handles at once: 256 KiB of tiny messages would take it 0.3 s.
        self.transport.max_size = READ_AT_ONCE  # type: ignore[attr-defined]  # asyncio's, but not in its interface
        prepare(self.transport)
        self.client = WebsocketClient(self)
        self.arrived: deque[int] = deque()  # a stamp for each message that waits to be taken
        self._arrivals = Arrivals(self.owner.clock, self.transport.get_extra_info("socket"))
        self._arrived = 0
        self._greeted = 0  # bytes
        self._parts = 0
        self.owner.connected(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.owner.disconnected(self)

    def data_received(self, data: bytes) -> None:
        self._arrived = self._arrivals.stamp(is_all=len(data) < READ_AT_ONCE)
        if self.protocol.state is State.CONNECTING:
            self._greeted += len(data)
        super().data_received(data)
        self.owner.holds(self.client, self.unfinished())
        if self.transport.get_write_buffer_size() > HIGH_WATER:  # pings without end, the answers to which are not read
            self.transport.abort()

    def process_event(self, event: Event) -> None:
        if isinstance(event, Part) and event.opcode in DATA_OPCODES:
            self._parts = 0 if event.fin else self._parts + 1
            if event.fin:
                self.arrived.append(self._arrived)
        super().process_event(event)

    def unfinished(self) -> int:
        """Bytes that the library keeps of a greeting, or of a message that is not whole."""
        if self.protocol.state is State.CONNECTING:
            return self._greeted
        return len(self.protocol.reader.buffer) + (self.protocol.current_size or 0) + PART_BYTES * self._parts

    def pause_writing(self) -> None:
        super().pause_writing()
        self.client.outflow.paused()

    def resume_writing(self) -> None:
        super().resume_writing()
        self.client.outflow.resumed()

"""A gateway's websocket clients, and the page that it shows in a browser. Knows nothing of what messages say."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from collections.abc import Sequence
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import DATA_OPCODES, CloseCode, Opcode
from websockets.frames import Frame as Part
from websockets.protocol import Event, State

from router.edges.gateway_arrival import Arrivals
from router.edges.gateway_http import Page
from router.edges.gateway_outflow import PIECE, Encoded, Outflow, label, prepare
from router.edges.gateway_stream import ACCEPTED_PER_TURN, StreamClient, StreamTransport
from router.edges.gateway_transport import HIGH_WATER, Ears, Frame
from router.edges.log import logger
from router.table.model import Address

PING_SECONDS = 20.0
"""How often a client is asked whether it is there, and how long it may take to answer."""

CLOSING_SECONDS = 1.0
"""How long clients have to say goodbye."""

READ_AT_ONCE = 4 * 1024
TAKEN_PER_TURN = 32
"""Bytes that are read, and messages that are handed on, of a client before other work of the loop has its turn."""

STRANGERS = 64
"""Connections beyond `max_clients` that may be without a websocket: they fetch the page, or are about to ask."""

PART_BYTES = 300
"""What each part of a message that is not whole takes up beside its bytes."""


class WebsocketTransport(StreamTransport):
    """`text`: the frames of one writing are one text message, joined by newlines; otherwise each is a binary message.

    `most` bounds in bytes what a client may send as one; who sends more is closed. `page` is HTML.
    """

    def __init__(self, address: Address, ears: Ears, text: bool, max_clients: int, most: int, page: bytes) -> None:
        super().__init__(address, ears, max_clients, most)
        self._text = text
        self._most = most
        self._page = Page(page)
        self._server: Server | None = None
        self._connections: set[_Connection] = set()
        self._strangers: dict[_Connection, None] = {}  # in the order in which they came

    def encode(self, frames: Sequence[Frame]) -> Encoded:
        messages = [frame.data for frame in frames]
        if self._text:
            messages = [b"\n".join(messages)] if messages else []
        opcode = Opcode.TEXT if self._text else Opcode.BINARY
        parts = [part for message in messages for part in _parts(opcode, message)]
        return Encoded(parts, sum(map(len, parts)))

    async def _serve(self, listening: socket.socket) -> None:
        self._server = await serve(
            self._serve_client,
            sock=listening,
            backlog=ACCEPTED_PER_TURN,
            create_connection=self._connection,  # type: ignore[arg-type]  # anything that makes one will do
            process_request=self._page.answer,
            compression=None,
            server_header=None,
            ping_interval=PING_SECONDS,
            ping_timeout=PING_SECONDS,
            close_timeout=CLOSING_SECONDS,
            max_size=self._most,
            write_limit=0,
            logger=_LOG,
        )

    async def _stop(self) -> None:
        if self._server is None:
            return
        self._server.close()
        for connection in list(self._connections):
            if connection.protocol.state is State.CONNECTING or connection.client.backlog():
                connection.transport.abort()
        await self._server.wait_closed()

    def _connection(self, *args: Any, **settings: Any) -> _Connection:
        """Called by the library for each connection, with what a ServerConnection is made of."""
        connection = _Connection(*args, **settings)
        connection.owner = self
        return connection

    def connected(self, connection: _Connection) -> None:
        """Where there is no room, that stranger gives way who has had most time to ask."""
        self._connections.add(connection)
        self._strangers[connection] = None
        if len(self._connections) > self._max_clients + STRANGERS:
            oldest = next(iter(self._strangers))
            del self._strangers[oldest]
            oldest.transport.abort()

    def disconnected(self, connection: _Connection) -> None:
        self._connections.discard(connection)
        self._strangers.pop(connection, None)
        self.holds_nothing(connection.client)

    async def _serve_client(self, connection: ServerConnection) -> None:
        assert isinstance(connection, _Connection)  # noqa: S101 - they come from here
        client = connection.client
        self._strangers.pop(connection, None)
        self.holds(client, connection.unfinished())  # no greeting any more
        if not self.came(client):
            await connection.close(CloseCode.TRY_AGAIN_LATER, "there are too many clients")
            return
        try:
            await self._hear(connection)
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code == CloseCode.MESSAGE_TOO_BIG:
                self.ears.refused("too_large")
        except Exception as error:  # noqa: BLE001 - a fault of the router, told loudly, where the library would hide it
            what = {"message": "a fault in the router itself ended a websocket", "exception": error}
            asyncio.get_running_loop().call_exception_handler(what)
        finally:
            self.went(client)

    async def _hear(self, connection: _Connection) -> None:
        """Raises ConnectionClosed in the end."""
        while True:
            for _ in range(TAKEN_PER_TURN):
                data = await connection.recv(decode=False)
                self.ears.received(connection.client, data, connection.arrived.popleft())
                self.trimmer.freed(len(data))
            await asyncio.sleep(0)


class _WebsocketClient(StreamClient):
    def __init__(self, connection: _Connection) -> None:
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


class _Connection(ServerConnection):
    """The library's, which also tells its client when the kernel takes no more, and when it does again."""

    owner: WebsocketTransport
    client: _WebsocketClient

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        # What asyncio reads at once, the library handles at once: 256 KiB of tiny messages would take it 0.3 s.
        self.transport.max_size = READ_AT_ONCE  # type: ignore[attr-defined]  # asyncio's, but not in its interface
        prepare(self.transport)
        self.client = _WebsocketClient(self)
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


def _parts(opcode: Opcode, message: bytes) -> list[bytes]:
    """A message as websocket frames; one that is large as several, between which other work and pings have a turn."""
    if len(message) <= PIECE:
        return [Part(opcode, message).serialize(mask=False)]
    whole = memoryview(message)
    return [
        Part(
            Opcode.CONT if start else opcode, whole[start : start + PIECE], fin=start + PIECE >= len(message)
        ).serialize(mask=False)
        for start in range(0, len(message), PIECE)
    ]


class _DebugLog(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        why = record.exc_info[1] if record.exc_info else None
        logger.debug("websockets says", what=record.getMessage(), why=repr(why))


_LOG = logging.getLogger("router.websocket")
"""Where the library tells who broke the rules of HTTP or left in the middle: seldom of use to an operator."""
_LOG.setLevel(logging.WARNING)
_LOG.propagate = False
_LOG.addHandler(_DebugLog())

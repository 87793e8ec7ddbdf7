"""A gateway's websocket clients, and the page that it shows in a browser. Knows nothing of what messages say."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Sequence
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode, Opcode
from websockets.frames import Frame as Part
from websockets.protocol import State

from router.gateway.transport.base import Ears, Frame
from router.gateway.transport.http import Page
from router.gateway.transport.outflow import PIECE, Encoded
from router.gateway.transport.stream import ACCEPTED_PER_TURN, StreamTransport
from router.gateway.transport.websocket_connection import WebsocketConnection
from router.log import logger
from router.table.model import Address

PING_SECONDS = 20.0
"""How often a client is asked whether it is there, and how long it may take to answer."""

CLOSING_SECONDS = 1.0
"""How long clients have to say goodbye."""

TAKEN_PER_TURN = 32
"""Messages of a client that are handed on before other work of the loop has its turn."""

STRANGERS = 64
"""Connections beyond `max_clients` that may be without a websocket: they fetch the page, or are about to ask."""


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
        self._connections: set[WebsocketConnection] = set()
        self._strangers: dict[WebsocketConnection, None] = {}  # in the order in which they came

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

    def _connection(self, *args: Any, **settings: Any) -> WebsocketConnection:
        """Called by the library for each connection, with what a ServerConnection is made of."""
        connection = WebsocketConnection(*args, **settings)
        connection.owner = self
        return connection

    def connected(self, connection: WebsocketConnection) -> None:
        """Where there is no room, that stranger gives way who has had most time to ask."""
        self._connections.add(connection)
        self._strangers[connection] = None
        if self.is_closing:
            connection.transport.abort()
        elif len(self._connections) > self._max_clients + STRANGERS:
            oldest = next(iter(self._strangers))
            del self._strangers[oldest]
            oldest.transport.abort()

    def disconnected(self, connection: WebsocketConnection) -> None:
        self._connections.discard(connection)
        self._strangers.pop(connection, None)
        self.holds_nothing(connection.client)

    async def _serve_client(self, connection: ServerConnection) -> None:
        assert isinstance(connection, WebsocketConnection)  # noqa: S101 - they come from here
        client = connection.client
        self._strangers.pop(connection, None)
        self.holds(client, connection.unfinished())  # no greeting any more
        try:
            if self.came(client):
                await self._hear(connection)
            else:
                await connection.close(CloseCode.TRY_AGAIN_LATER, "there are too many clients")
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code == CloseCode.MESSAGE_TOO_BIG:
                self.ears.refused("too_large")
        except Exception as error:  # noqa: BLE001 - a fault of the router, told loudly, where the library would hide it
            what = {"message": "a fault in the router itself ended a websocket", "exception": error}
            asyncio.get_running_loop().call_exception_handler(what)
        finally:
            self.went(client)

    async def _hear(self, connection: WebsocketConnection) -> None:
        """Raises ConnectionClosed in the end."""
        while True:
            for _ in range(TAKEN_PER_TURN):
                data = await connection.recv(decode=False)
                self.ears.received(connection.client, data, connection.arrived.popleft())
                self.trimmer.freed(len(data))
            await asyncio.sleep(0)


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

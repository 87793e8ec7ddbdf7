"""A gateway's websocket clients, and the page that the same port serves to browsers."""

from __future__ import annotations

import asyncio
import re
import socket
import struct
from collections.abc import Iterator, Sequence
from functools import partial
from http import HTTPStatus
from time import monotonic
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State

from router.assets import page_policy
from router.gateway.transport.base import HIGH_WATER, PER_TURN, Events, Frame, report_fault
from router.gateway.transport.stream import (
    ACCEPTED_PER_TURN,
    MESSAGE_SECONDS,
    Encoded,
    Limits,
    Part,
    StreamClient,
    StreamTransport,
    cut,
    size_of,
    together,
)
from router.log import logger_of_library
from router.net.doors import Door, is_foreign
from router.table.addresses import Address

PING_SECONDS = 20.0
"""Interval of pings, and the time a client has to answer one."""

CLOSING_SECONDS = 1.0
"""Time for the closing handshake."""

READ_AT_ONCE = 16 * 1024
"""Bytes of a client that the library reads and parses in one turn of the loop."""

STRANGERS, STRANGERS_PER_HOST = 64, 8
"""Connections allowed beyond the limits, to fetch the page or for handshakes: in total, and per host."""


class WebsocketTransport(StreamTransport):
    """Websocket. `text`: the frames of one `write` make up one text message; otherwise each is a binary message.

    A client whose message exceeds the limit is disconnected. `page` is HTML.
    """

    def __init__(
        self, address: Address, events: Events, limits: Limits, door: Door, *, text: bool, page: bytes
    ) -> None:
        super().__init__(address, events, limits, door)
        self._text = text
        self._page = Page(page)
        self._server: Server | None = None
        self._connections: set[Connection] = set()

    def encode(self, frames: Sequence[Frame]) -> Encoded:
        opcode = Opcode.TEXT if self._text else Opcode.BINARY
        messages = [cut(frame.data) for frame in frames]
        if self._text and messages:
            messages = [[*messages[0], *(part for message in messages[1:] for part in (b"\n", *message))]]
        pieces = [piece for message in messages for piece in _serialized(opcode, message)]
        return Encoded(pieces, sum(map(size_of, pieces)))

    async def _serve(self, listening: socket.socket) -> None:
        self._server = await serve(
            self._serve_client,
            sock=listening,
            backlog=ACCEPTED_PER_TURN,
            create_connection=partial(Connection, owner=self),  # type: ignore[arg-type]  # a factory is accepted
            process_request=self._page.answer,
            compression=None,
            server_header=None,
            open_timeout=MESSAGE_SECONDS,
            ping_interval=PING_SECONDS,
            ping_timeout=PING_SECONDS,
            close_timeout=CLOSING_SECONDS,
            max_size=self.limits.message,
            write_limit=0,
            logger=_LOG,
        )

    async def _stop(self) -> None:
        if self._server is None:
            return
        self._server.close()
        for connection in self._connections:
            if connection.state is State.CONNECTING or connection.client.backlog():
                connection.client.close()
        await self._server.wait_closed()

    def connected(self, connection: Connection) -> None:
        """Called for each TCP connection, before its handshake."""
        hosts = [connection.client.host for connection in self._connections]
        limits = Limits(self.limits.clients + STRANGERS, self.limits.clients_per_host + STRANGERS_PER_HOST, 0)
        self._connections.add(connection)
        if self.is_closing or not self.admits(connection.client) or limits.exceeded_by(connection.client.host, hosts):
            connection.client.close()

    def disconnected(self, connection: Connection, error: Exception | None) -> None:
        self._connections.discard(connection)
        if isinstance(error, TimeoutError):
            self.timed_out(connection.client)

    async def _serve_client(self, connection: ServerConnection) -> None:
        """Handle one websocket after its handshake."""
        assert isinstance(connection, Connection)  # noqa: S101 - see `create_connection`
        client = connection.client
        try:
            if refused := self.enter(client):
                await connection.close(CloseCode.TRY_AGAIN_LATER, refused)
            else:
                await self._read(connection)
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code == CloseCode.MESSAGE_TOO_BIG:
                self.events.refused("too_large")
        except Exception as error:  # noqa: BLE001 - a fault of the router, which the library would only log
            report_fault("ended a WebSocket connection", error)
        finally:
            self.leave(client)

    async def _read(self, connection: Connection) -> None:
        """Receive messages until ConnectionClosed is raised."""
        client = connection.client
        while True:
            for _ in range(PER_TURN):
                data = await connection.recv(decode=False)
                if client.unfinished_since is not None:  # the next message has begun
                    client.unfinished_since = monotonic()
                self.events.received(client, data, self.clock.stamp())
            await asyncio.sleep(0)


class Connection(ServerConnection):
    """The library's connection, which is also counted before the handshake, and tracks unfinished messages."""

    client: StreamClient

    def __init__(self, *args: Any, owner: WebsocketTransport, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._owner = owner

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.transport.max_size = READ_AT_ONCE  # type: ignore[attr-defined]  # asyncio's, but not in its interface
        self.client = StreamClient(self._owner, self.transport, self.drain, lambda: self.state is State.OPEN)
        self._owner.connected(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._owner.disconnected(self, exc)
        self.client.has_left()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if not self.protocol.reader.buffer and self.protocol.current_size is None:
            self.client.unfinished_since = None
        elif self.client.unfinished_since is None:
            self.client.unfinished_since = monotonic()
        if self.transport.get_write_buffer_size() > HIGH_WATER:  # an endless series of pings whose answers are not read
            self.client.close()


class Page:
    """HTTP responses of the websocket port: one page, which loads nothing from other hosts."""

    _HOST = re.compile(r"[A-Za-z0-9.:\[\]-]+")

    def __init__(self, html: bytes) -> None:
        self._html = html
        self._policy = page_policy(html)

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None continues with the websocket handshake."""
        if any(value.lower() == "websocket" for value in request.headers.get_all("Upgrade")):
            origins = request.headers.get_all("Origin")
            if origins and is_foreign(request.headers.get_all("Host"), origins):  # browsers always send an origin
                return connection.respond(
                    HTTPStatus.FORBIDDEN,
                    "pages of other hosts may not connect; open the page at this computer's address\n",
                )
            return None
        if request.path.partition("?")[0] != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "not found; the only page is /\n")
        return Response(HTTPStatus.OK, "OK", self._headers(request.headers), self._html)

    def _headers(self, request: Headers) -> Headers:
        host = self._HOST.fullmatch("".join(request.get_all("Host")))
        # In older browsers 'self' does not include websockets of the same host.
        sockets = f" ws://{host.group()} wss://{host.group()}" if host else ""
        return Headers(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Length": str(len(self._html)),
                "Cache-Control": "no-store",
                "Content-Security-Policy": f"{self._policy}; connect-src 'self'{sockets}",
                "X-Content-Type-Options": "nosniff",
                "Connection": "close",
            }
        )


def _serialized(opcode: Opcode, message: Sequence[Part]) -> Iterator[Sequence[Part]]:
    """Yield a message as websocket frames; a large one is split into several, so that pings can pass between them."""
    contents = list(together(message)) or [[]]
    for number, content in enumerate(contents):
        size = size_of(content)
        kind, is_last = (Opcode.CONT if number else opcode), number == len(contents) - 1
        # RFC 6455, 5.2: FIN and opcode, then the length in 7 bits, or in 16 bits after 126. A server does not mask.
        first = is_last << 7 | kind
        yield struct.pack(">BB", first, size) if size < 126 else struct.pack(">BBH", first, 126, size), *content


_LOG = logger_of_library("router.websocket", "websockets")

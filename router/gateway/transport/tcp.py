"""A gateway's TCP clients: length-prefixed packets or lines, both ways. Knows nothing of what they say."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence

from router.gateway.transport.arrival import Arrivals
from router.gateway.transport.base import Ears, Frame
from router.gateway.transport.outflow import PIECE, Encoded, Outflow, Piece, label, prepare
from router.gateway.transport.splitting import LENGTH, Lines, Packets, Splitter, TooLongError
from router.gateway.transport.stream import ACCEPTED_PER_TURN, StreamClient, StreamTransport
from router.log import logger
from router.table.model import Address

READ_AT_ONCE = 16 * 1024
TAKEN_PER_TURN = 32
"""Packets or lines of a client that are handed on before other work of the loop has its turn."""


class TcpTransport(StreamTransport):
    """`prefixed`: each packet preceded by its length, u32 little-endian; otherwise one line each.

    `most` bounds in bytes what a client may send as one; who sends more is closed.
    """

    def __init__(self, address: Address, ears: Ears, prefixed: bool, max_clients: int, most: int) -> None:
        super().__init__(address, ears, max_clients, most)
        self._prefixed = prefixed
        self._most = most
        self._server: asyncio.Server | None = None
        self._inbox = memoryview(bytearray(READ_AT_ONCE))  # one for all: what is in it is taken at once

    def encode(self, frames: Sequence[Frame]) -> Encoded:
        """Small frames are copied together; a large one is only looked at, piece by piece."""
        pieces: list[Piece] = []
        small: list[bytes] = []
        small_bytes = size = 0
        for frame in frames:
            before, after = (LENGTH.pack(len(frame.data)), b"") if self._prefixed else (b"", b"\n")
            size += len(before) + len(frame.data) + len(after)
            small.append(before)
            if len(frame.data) > PIECE:
                pieces.append(b"".join(small))
                whole = memoryview(frame.data)
                pieces += [whole[start : start + PIECE] for start in range(0, len(whole), PIECE)]
                small, small_bytes = [after], 0
                continue
            small += frame.data, after
            small_bytes += len(frame.data)
            if small_bytes > PIECE:
                pieces.append(b"".join(small))
                small, small_bytes = [], 0
        pieces.append(b"".join(small))
        return Encoded([piece for piece in pieces if piece], size)

    async def _serve(self, listening: socket.socket) -> None:
        make, loop = self._connection, asyncio.get_running_loop()
        self._server = await loop.create_server(make, sock=listening, backlog=ACCEPTED_PER_TURN)

    async def _stop(self) -> None:
        if self._server is not None:
            self._server.close()
        for client in list(self._clients):
            client.close()
        while self._clients:  # each is told in a turn of the loop of its own
            await asyncio.sleep(0)

    def _connection(self) -> _TcpClient:
        return _TcpClient(self, self._inbox, Packets(self._most) if self._prefixed else Lines(self._most))

    def too_long(self, client: _TcpClient, error: TooLongError) -> None:
        """What it sends can no longer be told apart."""
        self.ears.refused("too_large")
        self._log.note("too_long", logger.warning, "a client was closed", client=client.label, why=str(error))
        client.close()


class _TcpClient(asyncio.BufferedProtocol, StreamClient):
    def __init__(self, owner: TcpTransport, inbox: memoryview, incoming: Splitter) -> None:
        self.encode = owner.encode
        self._owner = owner
        self._inbox = inbox
        self._incoming = incoming
        self._loop = asyncio.get_running_loop()

    def close(self) -> None:
        self._transport.abort()

    # -- what asyncio calls --------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - what a server's are
        self._transport = transport
        self._arrivals = Arrivals(self._owner.clock, transport.get_extra_info("socket"))
        self.label = label(transport)
        prepare(transport)
        self.outflow = Outflow(transport, self._owner.feeder, lambda: True, self._drained)
        if not self._owner.came(self):
            transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._incoming.clear()
        self._owner.holds_nothing(self)
        self._owner.went(self)

    def pause_writing(self) -> None:
        self.outflow.paused()

    def resume_writing(self) -> None:
        self.outflow.resumed()

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._inbox

    def buffer_updated(self, nbytes: int) -> None:
        self._arrived = self._arrivals.stamp(is_all=nbytes < READ_AT_ONCE)
        self._incoming.feed(self._inbox[:nbytes])
        self._take()

    def eof_received(self) -> None:
        self.close()  # one that only sends, and wants no answer, has sent all

    # ------------------------------------------------------------------------------------------------------------

    def _take(self) -> None:
        """Hands on what is complete; who sends much waits until others had their turn."""
        for _ in range(TAKEN_PER_TURN):
            if self._transport.is_closing():
                return
            try:
                one = self._incoming.take()
            except TooLongError as error:
                self._owner.too_long(self, error)
                return
            if one is None:
                self._owner.holds(self, len(self._incoming))
                self._transport.resume_reading()
                return
            self._owner.ears.received(self, one, self._arrived)
            self._owner.trimmer.freed(len(one))
        self._transport.pause_reading()
        self._loop.call_soon(self._take)

    def _drained(self) -> None:
        self._owner.ears.drained(self)

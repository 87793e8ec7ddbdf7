"""Three stream transports, peers that connect to them, and what hostile peers send."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from router.gateway.transport.stream import Limits, StreamTransport
from router.gateway.transport.tcp import TcpTransport
from router.gateway.transport.websocket import WebsocketTransport
from router.net.addresses import family
from router.net.doors import Door
from router.table.addresses import Address
from tests.gateway.transport_events import Events, opened

KINDS = ("packets", "lines", "websocket")
ANY = Address("127.0.0.1", 0)
MOST = 1000
TEN = Limits(10, 10, MOST)
GREETING = (
    b"GET / HTTP/1.1\r\nHost: rover:8765\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
CLOSE = 8
"""The opcode of a WebSocket's close frame."""


OPEN = Door("gateways.test", (), Counter())
"""Admits everybody."""


def transport_of(
    kind: str, events: Events, limits: Limits = TEN, address: Address = ANY, door: Door = OPEN
) -> StreamTransport:
    if kind == "websocket":
        return WebsocketTransport(address, events, limits, door, text=False, page=b"")
    return TcpTransport(address, events, limits, door, prefixed=kind == "packets")


@asynccontextmanager
async def served(
    kind: str, limits: Limits = TEN, door: Door = OPEN, address: Address = ANY
) -> AsyncIterator[tuple[StreamTransport, Events]]:
    """An open transport and its events."""
    events = Events()
    transport = transport_of(kind, events, limits, address, door)
    async with opened(transport):
        yield transport, events


def framed(kind: str, *messages: bytes) -> bytes:
    """Frame messages as a client does."""
    frames = {
        "packets": lambda message: struct.pack("<I", len(message)) + message,
        "lines": lambda message: message + b"\n",
        "websocket": websocket_frame,
    }
    return b"".join(map(frames[kind], messages))


def websocket_frame(payload: bytes, opcode: int = 2, length: int | None = None, fin: bool = True) -> bytes:
    """Part of a WebSocket message from a client; the payload may be shorter than its declared length."""
    length = len(payload) if length is None else length
    return struct.pack(">BBH", opcode | fin << 7, 0x80 | 126, length) + bytes(4) + payload


class Peer:
    """A client that follows the protocol. `join` creates it."""

    def __init__(self, kind: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        self.label = str(Address(*writer.get_extra_info("sockname")[:2]))
        self._kind = kind
        self.reader = reader

    async def say(self, *messages: bytes) -> None:
        await self.send(framed(self._kind, *messages))

    async def send(self, data: bytes) -> None:
        self.writer.write(data)
        await self.writer.drain()

    async def hear(self) -> bytes:
        """Wait for the next message. Raises IncompleteReadError at the end."""
        if self._kind == "lines":
            return (await self.reader.readuntil(b"\n"))[:-1]
        if self._kind == "packets":
            return await self.reader.readexactly(struct.unpack("<I", await self.reader.readexactly(4))[0])
        message, is_whole = b"", False
        while not is_whole:
            first, length = await self.reader.readexactly(2)
            if length > 125:
                length = int.from_bytes(await self.reader.readexactly(2 if length == 126 else 8), "big")
            message += await self.reader.readexactly(length)
            is_whole = first >= 0x80
            if first & 0xF == CLOSE:
                raise asyncio.IncompleteReadError(message, None)
        return message

    async def is_closed(self) -> bool:
        """Whether the other side soon closes the connection, ignoring earlier messages."""

        async def hear_all() -> None:
            with suppress(ConnectionError, asyncio.IncompleteReadError):
                while True:
                    await self.hear()

        try:
            await asyncio.wait_for(hear_all(), 5.0)
        except asyncio.TimeoutError:
            return False
        return True

    def stand_still(self) -> None:
        """Stop reading."""
        self.writer.transport.pause_reading()  # type: ignore[attr-defined]  # a stream's transport

    def leave(self) -> None:
        self.writer.transport.abort()


async def join(kind: str, transport: StreamTransport, host: str = ANY.host) -> Peer:
    """Connect from a local address, with a small receive buffer, and shake hands."""
    assert transport.address is not None
    opened = socket.socket(family(host), socket.SOCK_STREAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    opened.setblocking(False)
    opened.bind((host, 0))
    await asyncio.get_running_loop().sock_connect(opened, transport.address)
    reader, writer = await asyncio.open_connection(sock=opened, limit=1 << 24)
    if kind == "websocket":
        writer.write(GREETING)
        assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
    return Peer(kind, reader, writer)

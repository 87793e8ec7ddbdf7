"""A gateway's TCP clients: length-prefixed packets or lines, both ways."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Sequence
from time import monotonic

from router.gateway.transport.base import PER_TURN, Events, Frame, report_fault
from router.gateway.transport.stream import ACCEPTED_PER_TURN, Encoded, Limits, StreamClient, StreamTransport, cut
from router.net.doors import Door
from router.table.addresses import Address

LENGTH = struct.Struct("<I")
"""Precedes each packet."""

JSON_WHITESPACE = b" \t\r\n"


class TooLongError(ValueError):
    """A packet or line exceeds the limit."""


class TcpTransport(StreamTransport):
    """TCP. `prefixed`: each packet is preceded by its length, u32 little-endian; otherwise each is a line.

    A client whose message exceeds the limit is disconnected.
    """

    def __init__(self, address: Address, events: Events, limits: Limits, door: Door, *, prefixed: bool) -> None:
        super().__init__(address, events, limits, door)
        self._prefixed = prefixed
        self._server: asyncio.Server | None = None

    def encode(self, frames: Sequence[Frame]) -> Encoded:
        if self._prefixed:
            return Encoded.of(part for frame in frames for part in (LENGTH.pack(len(frame.data)), *cut(frame.data)))
        return Encoded.of(part for frame in frames for part in (*cut(frame.data), b"\n"))

    async def _serve(self, listening: socket.socket) -> None:
        limit = self.limits.message - 1  # of a line without its first byte
        self._server = await asyncio.start_server(
            self._serve_client, sock=listening, backlog=ACCEPTED_PER_TURN, limit=limit
        )

    async def _stop(self) -> None:
        if self._server is not None:
            self._server.close()
        for client in self._clients:
            client.close()
        while self._clients:  # each leaves in its own turn of the loop
            await asyncio.sleep(0)

    async def _serve_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = StreamClient(self, writer.transport, writer.drain)  # type: ignore[arg-type]  # a server's transport
        try:
            if self.admits(client) and not self.enter(client):
                await self._read(client, reader)
        except TooLongError as error:  # the beginning of the next message is unknown
            self.events.refused("too_large")
            self.close_client(client, "client disconnected", why=str(error))
        except TimeoutError:
            self.timed_out(client)
        except (asyncio.IncompleteReadError, OSError):
            pass  # the client left
        except Exception as error:  # noqa: BLE001 - a fault of the router, reported; it ends only this client
            report_fault("ended a TCP connection", error)
        finally:
            client.close()
            client.has_left()
            self.leave(client)

    async def _read(self, client: StreamClient, reader: asyncio.StreamReader) -> None:
        read_rest = self._read_packet if self._prefixed else self._read_line
        while True:
            for _ in range(PER_TURN):
                first = await reader.readexactly(1)
                client.unfinished_since = monotonic()
                data = await read_rest(reader, first)
                client.unfinished_since = None
                if not client.can_write():  # it was closed: discard what it sent before
                    return
                if data or self._prefixed:  # a blank line is no message
                    self.events.received(client, data, self.clock.stamp())
            await asyncio.sleep(0)

    async def _read_packet(self, reader: asyncio.StreamReader, first: bytes) -> bytes:
        (length,) = LENGTH.unpack(first + await reader.readexactly(LENGTH.size - 1))
        if length > self.limits.message:
            raise TooLongError(f"a packet of {length} bytes exceeds the limit of {self.limits.message}")
        return await reader.readexactly(length)

    async def _read_line(self, reader: asyncio.StreamReader, first: bytes) -> bytes:
        if first == b"\n":
            return b""
        try:
            line = first + await reader.readuntil(b"\n")
        except asyncio.LimitOverrunError:
            raise TooLongError(f"a line exceeds the limit of {self.limits.message} bytes") from None
        return line.strip(JSON_WHITESPACE)

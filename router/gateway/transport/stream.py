"""The base of the TCP and websocket transports: a listener with limits, and clients with a buffer each."""

from __future__ import annotations

import asyncio
import socket
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from time import monotonic
from typing import Any, NamedTuple, Union

from router.gateway.transport.arrival import LoopClock
from router.gateway.transport.base import LOW_WATER, Client, Events, Frame
from router.gateway.transport.binding import MOST_UNACCEPTED, Binding, listen_at
from router.hosts import with_port
from router.log import FloodLog, logger
from router.net.addresses import bound_address
from router.net.doors import Door
from router.table.addresses import Address

PIECE = 64 * 1024
"""Bytes written to a connection at a time. Frames are shared by all clients; only one piece is copied for each."""

HEAD = 16
"""More bytes than a transport puts before a piece: the two are written together."""

UNSENT = 128 * 1024
"""Bytes that the kernel keeps unsent for a client. Newer values can still replace those that wait in the router.
"""

STALLED_SECONDS = 60.0
"""The kernel closes the connection of a client that acknowledges or reads nothing for this long."""

MESSAGE_SECONDS = 10.0
"""Timeout for one message of a client, from its first byte to its last, and for the websocket handshake."""

WATCH_SECONDS = 1.0
"""The interval of checks of that timeout."""

_LAST_DATA_SENT = struct.Struct("44xI")
"""The beginning of Linux's struct tcp_info, with tcpi_last_data_sent in ms."""

ACCEPTED_PER_TURN = 16
"""Connections that are accepted before the loop continues with other work."""

Part = Union[bytes, memoryview]


class Limits(NamedTuple):
    """Maximum clients in total, clients from one host, and bytes of one message from a client."""

    clients: int
    clients_per_host: int
    message: int

    def exceeded_by(self, host: str, hosts: Sequence[str]) -> str:
        """Return the key of the limit that a further connection from `host` would exceed, or ""."""
        if len(hosts) >= self.clients:
            return "max_clients"
        return "max_clients_per_host" if hosts.count(host) >= self.clients_per_host else ""


class Encoded(NamedTuple):
    """Frames in their wire form, as pieces of parts. Other data (pings) may be written between two pieces.

    Large parts are views of the frames, so clients that wait for the same frames share their memory.
    """

    pieces: Sequence[Sequence[Part]]
    size: int

    @classmethod
    def of(cls, parts: Iterable[Part]) -> Encoded:
        """Make pieces of these parts (see `together`)."""
        pieces = list(together(parts))
        return cls(pieces, sum(map(size_of, pieces)))


def cut(data: bytes) -> list[Part]:
    """Return views of `data`, each of which leaves room for HEAD bytes in a PIECE."""
    if len(data) <= PIECE - HEAD:
        return [data]
    whole = memoryview(data)
    return [whole[start : start + PIECE - HEAD] for start in range(0, len(data), PIECE - HEAD)]


def together(parts: Iterable[Part]) -> Iterator[list[Part]]:
    """Yield pieces of at most PIECE - HEAD bytes."""
    piece: list[Part] = []
    size = 0
    for part in parts:
        if piece and size + len(part) > PIECE - HEAD:
            yield piece
            piece, size = [], 0
        piece.append(part)
        size += len(part)
    if piece:
        yield piece


def size_of(piece: Sequence[Part]) -> int:
    return sum(map(len, piece))


class StreamClient:
    """A Client behind a connection. `drain` waits until the buffer of `connection` is empty.

    `unfinished_since` is the monotonic time of the first byte of a message that is not complete.
    """

    def __init__(
        self,
        owner: StreamTransport,
        connection: asyncio.Transport,
        drain: Callable[[], Awaitable[None]],
        is_open: Callable[[], bool] = lambda: True,
    ) -> None:
        peer = connection.get_extra_info("peername")
        self.has_left_early = peer is None
        peer = peer or ("a client that has left", 0)
        self.host: str = peer[0]
        self.own_host: str = (connection.get_extra_info("sockname") or ("", 0))[0]
        self.label = with_port(self.host, peer[1])
        self.unfinished_since: float | None = None
        self._owner = owner
        self._connection = connection
        self._drain = drain
        self._is_open = is_open
        self._pieces: deque[Sequence[Part]] = deque()
        self._waiting = 0
        self._writing: asyncio.Handle | asyncio.Task[None] | None = None
        _configure(connection)
        owner.clock.start(_age_ns(connection))  # it may have waited to be accepted, with messages

    def write(self, frames: Sequence[Frame]) -> None:
        self.push(self._owner.encode(frames))

    def push(self, encoded: Encoded) -> None:
        if not self.can_write():
            return
        self._pieces.extend(encoded.pieces)
        self._waiting += encoded.size
        if self._writing is None:
            self._writing = asyncio.get_running_loop().call_soon(self._begin)

    def backlog(self) -> int:
        return self._waiting + self._connection.get_write_buffer_size()

    def can_write(self) -> bool:
        return self._is_open() and not self._connection.is_closing()

    def close(self) -> None:
        self._connection.abort()

    def has_left(self) -> None:
        """Free what was not written, whatever still refers to the client. Called once."""
        self._pieces.clear()
        self._waiting = 0
        self._owner.clock.stop()

    def _begin(self) -> None:
        """Write what has been pushed in this turn of the loop.

        Not from `push`: if that fails, the error refers to the frames of all callers, and thus to their messages, until
        it is garbage-collected.
        """
        self._writing = None
        self._write_now()
        if self.backlog():
            self._writing = asyncio.get_running_loop().create_task(self._write_later())

    def _write_now(self) -> None:
        """Write pieces, small ones together, until the kernel takes no more."""
        connection = self._connection
        while self._pieces and not connection.get_write_buffer_size() and not connection.is_closing():
            connection.write(self._next())

    def _next(self) -> bytes:
        batch = [*self._pieces.popleft()]
        size = size_of(batch)
        while self._pieces and size + size_of(self._pieces[0]) <= PIECE:
            size += size_of(self._pieces[0])
            batch += self._pieces.popleft()
        self._waiting -= size
        return b"".join(batch)

    async def _write_later(self) -> None:
        try:
            with suppress(OSError):  # the connection ended
                while self.backlog():
                    await self._drain()
                    if not self.can_write():
                        return
                    self._write_now()
                    if self.backlog() < LOW_WATER:
                        self._owner.events.drained(self)
        finally:
            self._writing = None


class StreamTransport(ABC):
    """Listens, and enforces `door`, `limits` and the timeout for a message. `address` is known once it is bound."""

    def __init__(self, address: Address, events: Events, limits: Limits, door: Door) -> None:
        self.address: Address | None = None
        self.events = events
        self.limits = limits
        self.clock = LoopClock()
        self.is_closing = False
        self._door = door
        self._requested = address
        self._clients: set[StreamClient] = set()
        self._binding = Binding("tcp", address, self._bind)
        self._watching: asyncio.TimerHandle | None = None
        self._log = FloodLog()

    async def open(self) -> None:
        await self._binding.open()
        self._watch()

    async def close(self) -> None:
        self.is_closing = True  # connections that are being accepted are rejected
        await self._binding.close()
        if self._watching is not None:
            self._watching.cancel()
        await self._stop()
        self._log.flush(final=True)
        self._door.close()

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        encoded = self.encode(frames)
        for client in clients:
            assert isinstance(client, StreamClient)  # noqa: S101 - a client of this transport
            client.push(encoded)

    @abstractmethod
    def encode(self, frames: Sequence[Frame]) -> Encoded: ...

    @abstractmethod
    async def _serve(self, listening: socket.socket) -> None: ...

    @abstractmethod
    async def _stop(self) -> None: ...

    async def _bind(self) -> None:
        listening = listen_at(self._requested)
        try:
            await self._serve(listening)
        except BaseException:
            listening.close()
            raise
        listening.listen(MOST_UNACCEPTED)
        self.address = Address(*bound_address(listening))

    def admits(self, client: StreamClient) -> bool:
        """Return whether the client is in a network that may connect; otherwise count and log it."""
        return client.has_left_early or self._door.admits(client.host, client.own_host)

    def enter(self, client: StreamClient) -> str:
        """Add a client and return "", or return (and log) why it is rejected."""
        if self.is_closing:
            return "the gateway is shutting down"
        if key := self.limits.exceeded_by(client.host, [other.host for other in self._clients]):
            what = "too many clients" + (" from this host" if "host" in key else "") + "; client rejected"
            self._log.note(key, logger.warning, what, client=client.label, limit=key)
            return what
        self._clients.add(client)
        self.events.joined(client)
        return ""

    def leave(self, client: StreamClient) -> None:
        """Remove a client, unless it was rejected."""
        if client in self._clients:
            self._clients.remove(client)
            self.events.left(client)

    def close_client(self, client: StreamClient, what: str, **details: Any) -> None:
        """Log why a client is closed, and close it."""
        self._log.note(what, logger.warning, what, client=client.label, **details)
        client.close()

    def timed_out(self, client: StreamClient) -> None:
        """Log that the kernel closed the connection of a client that read or acknowledged nothing."""
        what = "client disconnected: it does not read, or its computer does not answer"
        self.close_client(client, what, seconds=STALLED_SECONDS)

    def _watch(self) -> None:
        begun_before = monotonic() - MESSAGE_SECONDS
        for client in self._clients:
            if client.unfinished_since is not None and client.unfinished_since < begun_before:
                self.close_client(
                    client, f"client disconnected: it did not finish a message within {MESSAGE_SECONDS:g} s"
                )
        self._log.flush()
        self._watching = asyncio.get_running_loop().call_later(WATCH_SECONDS, self._watch)


def _age_ns(connection: asyncio.Transport) -> int:
    """Return how long ago a connection on which nothing has been sent was established."""
    opened: socket.socket = connection.get_extra_info("socket")
    info = opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _LAST_DATA_SENT.size)
    return int(_LAST_DATA_SENT.unpack(info)[0]) * 1_000_000


def _configure(connection: asyncio.Transport) -> None:
    connection.set_write_buffer_limits(0)  # `drain` waits for an empty buffer
    opened: socket.socket = connection.get_extra_info("socket")
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
    # Detect a computer that disappeared, even while nothing is sent to it, and a client that reads nothing.
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 20)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 10)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(STALLED_SECONDS * 1000))

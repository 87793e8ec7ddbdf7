"""What one TCP or websocket client still has to get: pieces that all clients share, fed to its socket as it takes them.

No more than one piece is in a buffer of the client's own: a thousand clients that stand still cost no more than one
does. Knows no framing.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from typing import NamedTuple, Union

from router.gateway.transport.base import HIGH_WATER, LOW_WATER

PIECE = 64 * 1024
"""Bytes that a client gets at a time at most: other clients have their turn between two pieces."""

BYTES_PER_TURN = 256 * 1024
BYTES_PER_CALL = 8 * 1024
"""So much goes out in one turn of the loop, a system call counting as so many bytes at least: about 1 ms."""

UNSENT = 128 * 1024
"""Bytes that the kernel keeps unsent for a client: beyond that, the newest values are worth more than old ones."""

STALLED_SECONDS = 60.0
"""A client that takes nothing for so long, while something waits for it, is closed."""

SILENCE_SECONDS = 60.0
"""A client whose computer confirms nothing for so long has gone."""

Piece = Union[bytes, memoryview]


class Encoded(NamedTuple):
    """Frames as they go to every client. Between pieces, others may be written (the library's pings)."""

    pieces: Sequence[Piece]
    size: int


def prepare(transport: asyncio.Transport) -> None:
    """Sets up a new client's connection."""
    transport.set_write_buffer_limits(0)  # so that each byte in the transport's own buffer is told
    connected: socket.socket = transport.get_extra_info("socket")
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
    # A client whose computer has gone without a word, whether something is sent to it or not.
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 20)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 10)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(SILENCE_SECONDS * 1000))


def label(transport: asyncio.Transport) -> str:
    """Who is at the other end, as 10.0.0.5:51234."""
    host, port = transport.get_extra_info("peername") or ("a client that has gone", 0)
    return f"{host}:{port}"


class Feeder:
    """Gives clients what waits for them, one after the other, and lets other work have its turn in between."""

    def __init__(self) -> None:
        self._ready: deque[Outflow] = deque()
        self._is_scheduled = False

    def add(self, outflow: Outflow) -> None:
        self._ready.append(outflow)
        self._schedule()

    def _schedule(self) -> None:
        if self._ready and not self._is_scheduled:
            self._is_scheduled = True
            asyncio.get_running_loop().call_soon(self._feed)

    def _feed(self) -> None:
        """One turn of the loop."""
        self._is_scheduled = False
        left = BYTES_PER_TURN
        while self._ready and left > 0:
            left -= max(self._ready.popleft().feed(), BYTES_PER_CALL)
        self._schedule()


class Outflow:
    """What one client still has to get, while `is_open`. Its protocol passes on when it is paused and resumed."""

    def __init__(
        self,
        transport: asyncio.Transport,
        feeder: Feeder,
        is_open: Callable[[], bool],
        drained: Callable[[], None],
    ) -> None:
        self._transport = transport
        self._feeder = feeder
        self._is_open = is_open
        self._drained = drained
        self._waiting: deque[Piece] = deque()
        self._waiting_bytes = 0
        self._is_paused = False
        self._is_queued = False
        self._was_high = False
        self._pushed = 0
        self._taken = 0  # by the kernel, when it was looked at last
        self._taken_at = monotonic()

    def push(self, encoded: Encoded) -> None:
        if not self._can_write():
            return
        self._pushed += encoded.size
        self._waiting_bytes += encoded.size
        self._waiting.extend(encoded.pieces)
        self._was_high = self._was_high or self.backlog() >= HIGH_WATER
        self._queue()

    def feed(self) -> int:
        """Writes one piece, or several small ones as one, and returns how many bytes that was."""
        self._is_queued = False
        if self._is_paused or not self._waiting or not self._can_write():
            return 0
        pieces = [self._waiting.popleft()]
        size = len(pieces[0])
        while self._waiting and size + len(self._waiting[0]) <= PIECE:
            size += len(self._waiting[0])
            pieces.append(self._waiting.popleft())
        self._waiting_bytes -= size
        self._transport.write(pieces[0] if len(pieces) == 1 else b"".join(pieces))
        self._queue()
        self._look_at_level()
        return size

    def backlog(self) -> int:
        return self._waiting_bytes + self._transport.get_write_buffer_size()

    def paused(self) -> None:
        self._is_paused = True

    def resumed(self) -> None:
        self._is_paused = False
        self._queue()
        self._look_at_level()

    def clear(self) -> None:
        """Forgets what waits: the client has gone."""
        self._waiting.clear()
        self._waiting_bytes = 0

    def is_stalled(self, now: float) -> bool:
        """Whether the kernel has taken nothing for STALLED_SECONDS. To be asked now and then."""
        backlog = self.backlog()
        taken = self._pushed - backlog
        if not backlog or taken != self._taken:
            self._taken, self._taken_at = taken, now
        return now - self._taken_at >= STALLED_SECONDS

    def _queue(self) -> None:
        if self._waiting and not self._is_paused and not self._is_queued:
            self._is_queued = True
            self._feeder.add(self)

    def _look_at_level(self) -> None:
        if self._was_high and self.backlog() < LOW_WATER:
            self._was_high = False
            asyncio.get_running_loop().call_soon(self._tell_drained)

    def _tell_drained(self) -> None:
        if self._can_write():
            self._drained()

    def _can_write(self) -> bool:
        return self._is_open() and not self._transport.is_closing()

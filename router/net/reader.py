"""One listener's datagrams: taken one by one or as many as are there, and how long to rest between two looks.

Knows no thread and no other listener.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from time import monotonic_ns

from router.net.coalescing import SAMPLE, Coalescing
from router.net.udp import Listener

Receive = Callable[[bytes, "tuple[str, int]"], None]

WAIT = socket.MSG_TRUNC.value
_LOOK = WAIT | socket.MSG_DONTWAIT.value

_TIMEVAL = struct.Struct("@ll")

TURN = 4
"""The most that one of several listeners may hand in while the others wait."""


class Intake:
    """`size` is the most that is received of a datagram, in bytes. `enough` is as in `Coalescing`."""

    def __init__(self, listener: Listener, receive: Receive, size: int, enough: Callable[[], int]) -> None:
        self.listener = listener
        self.descriptor = listener.socket.fileno()
        self._socket = listener.socket
        self.receive_from = listener.socket.recvfrom
        self.receive = receive
        self.size = size
        self.coalescing = Coalescing(listener.coalesce, enough)
        self._taken = 0  # since the last look at the clock, or the last rest
        self._since = 0

    def wait_at_most(self, seconds: float) -> None:
        """A blocking receive ends with BlockingIOError after that; Python's own timeout would cost a call of poll."""
        timeout = _TIMEVAL.pack(int(seconds), int(seconds % 1 * 1e6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)

    def take(self, most: int) -> int:
        """Takes what has arrived, and returns how much that was: less than `most` when there is no more."""
        receive, receive_from, size, flags = self.receive, self.receive_from, self.size, _LOOK
        for taken in range(most):
            try:
                data, peer = receive_from(size, flags)
            except BlockingIOError:  # also for one that arrived damaged
                return taken
            receive(data, peer)
        return most

    def take_one(self) -> tuple[int, float]:
        """For one of several listeners that was waited for: how many it took, and for how long it rests then."""
        taken, rest = self.take(1), 0.0
        self._taken += taken
        if self._taken == SAMPLE:
            now = monotonic_ns()
            rest = self.coalescing.first(now - self._since)
            self._taken, self._since = 0, now
        return taken, rest

    def take_some(self) -> tuple[int, float]:
        """For one of several listeners that has rested: the same, but the rest only after less than a whole turn."""
        taken, rest = self.take(TURN), 0.0
        self._taken += taken
        if taken < TURN:
            rest = self.coalescing.next(self._taken)
            self._taken, self._since = 0, monotonic_ns()
        return taken, rest

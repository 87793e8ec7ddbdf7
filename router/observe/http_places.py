"""Which connections over HTTP are open, how many each host may have, and which one goes where another needs its place.

A newcomer gets in, also on the host of those that have all places: of the connections that share its limit, one ends
that was answered, or else that has not asked, or else that waits for its answer; of these the one without progress for
longest.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from time import monotonic, sleep

MOST_PER_HOST = 16
"""Connections. The router's own computer counts as one host, whatever its addresses."""

MOST_FROM_OTHERS = 48
"""Connections of all other computers together: what they do leaves the places of the router's own alone."""

MOST_TAPS = 6

STALLED_SECONDS = 3.0
"""A tap, which has something to say each second, is ended for another connection if nothing is taken for so long."""

REST_SECONDS = 0.003

_RESET = struct.pack("ii", 1, 0)

OWN_COMPUTER = "own"


class _Stage(IntEnum):
    """In the order in which connections end for newcomers."""

    ANSWERED = 0
    NEW = 1
    ASKING = 2


class Places:
    """Any thread may call it."""

    def __init__(self) -> None:
        self._host: dict[socket.socket, str] = {}
        self._progress: dict[socket.socket, float] = {}  # monotonic, s; longest without progress first
        self._stage: dict[socket.socket, _Stage] = {}
        self._busy: set[socket.socket] = set()
        self._taps: set[socket.socket] = set()
        self._lock = threading.Lock()

    def enter(self, connection: socket.socket, host: str) -> bool:
        """Return whether there is a place. `host` is OWN_COMPUTER or an IP address.

        Sleeps for REST_SECONDS where another connection was ended, so that a newcomer has time to ask.
        """
        with self._lock:
            before = len(self._host)
            is_own = host == OWN_COMPUTER
            has_place = self._makes_room(self._of(lambda other: other == host), MOST_PER_HOST) and (
                is_own or self._makes_room(self._of(lambda other: other != OWN_COMPUTER), MOST_FROM_OTHERS)
            )
            is_crowded = len(self._host) < before
            if has_place:
                self._host[connection] = host
                self._progress[connection] = monotonic()
                self._stage[connection] = _Stage.NEW
        if is_crowded:
            sleep(REST_SECONDS)
        return has_place

    def enter_tap(self, connection: socket.socket) -> bool:
        """Return whether a connection may become a tap."""
        with self._lock:
            if not self._makes_room(self._taps, MOST_TAPS):
                return False
            self._taps.add(connection)
            return True

    def asks(self, connection: socket.socket) -> bool:
        """Note that there is a whole request. Return whether the connection has its place still."""
        return self._proceeds(connection, _Stage.ASKING)

    def is_answered(self, connection: socket.socket) -> None:
        """Note that an answer begins, or that some of it was taken."""
        self._proceeds(connection, _Stage.ANSWERED)

    def _proceeds(self, connection: socket.socket, stage: _Stage) -> bool:
        with self._lock:
            if self._progress.pop(connection, None) is None:
                return False
            self._progress[connection] = monotonic()
            self._stage[connection] = stage
            return True

    @contextmanager
    def busy(self, connection: socket.socket) -> Iterator[None]:
        """Inside, it is the router that the other end waits for: the connection keeps its place."""
        with self._lock:
            self._busy.add(connection)
        try:
            yield
        finally:
            with self._lock:
                self._busy.discard(connection)

    def leave(self, connection: socket.socket) -> None:
        with self._lock:
            self._forget(connection)

    def end_all(self) -> None:
        """Whatever they are at: taps end, and what is kept alive between two requests."""
        with self._lock:
            for each in self._host:
                with suppress(OSError):  # its other end has gone already
                    each.shutdown(socket.SHUT_RDWR)

    def _of(self, is_meant: Callable[[str], bool]) -> frozenset[socket.socket]:
        return frozenset(each for each, host in self._host.items() if is_meant(host))

    def _makes_room(self, among: Collection[socket.socket], most: int) -> bool:
        if len(among) < most:
            return True
        can_end = [each for each in self._progress if each in among and not self._keeps_its_place(each)]
        longest = min(can_end, key=self._stage.__getitem__, default=None)  # the first of equals
        if longest is None:
            return False
        self._forget(longest)
        reset(longest)
        with suppress(OSError):  # its other end has gone already
            longest.shutdown(socket.SHUT_RDWR)
        return True

    def _keeps_its_place(self, connection: socket.socket) -> bool:
        if connection in self._taps:
            return monotonic() - self._progress[connection] < STALLED_SECONDS
        return connection in self._busy

    def _forget(self, connection: socket.socket) -> None:
        self._host.pop(connection, None)
        self._progress.pop(connection, None)
        self._stage.pop(connection, None)
        self._taps.discard(connection)


def reset(connection: socket.socket) -> None:
    """Have the kernel drop, when the connection is closed, what its other end has not taken."""
    with suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)

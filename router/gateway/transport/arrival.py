"""When what a stream brings arrived. The kernel stamps no stream, so that what a process finds after it stood still
looks as if it came just now: it counts as arrived when the process was last there. Knows no framing.
"""

from __future__ import annotations

import asyncio
import fcntl
import socket
import struct
import termios
from collections.abc import Callable

from router.clock import monotonic_ns, wall_ns

TICK_SECONDS = 0.02

AWAY_NS = 50_000_000
"""Without a tick for so long, the loop was away: it stood still, or something kept it."""

CATCH_UP_NS = 100_000_000
"""For so long after it came back, what is read may have been waiting."""

_LAST_SENT = struct.Struct("=44xI")
"""Of Linux's struct tcp_info: ms since something was sent; before anything was, since the connection was made."""


class LoopClock:
    """Knows when the loop was last there, while it is started. `clock_ns` is monotonic."""

    def __init__(self, clock_ns: Callable[[], int] = monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._seen = 0
        self._left = 0
        self._caught_up = 0
        self._ticking: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Does nothing if it is started."""
        if self._ticking is None:
            self._seen = self._clock_ns()
            self._tick_later()

    def stop(self) -> None:
        if self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None

    def away_since(self) -> int | None:
        """Since when something that is found now may have been waiting, by `clock_ns`; None if it has just come.

        For any thread.
        """
        if self._ticking is None:
            return None
        now = self._clock_ns()
        if now - self._seen > AWAY_NS:
            return self._seen
        return self._left if now < self._caught_up else None

    def tick(self) -> None:
        """The loop is there."""
        now = self._clock_ns()
        if now - self._seen > AWAY_NS:
            self._left, self._caught_up = self._seen, now + CATCH_UP_NS
        self._seen = now

    def _tick_later(self) -> None:
        self._ticking = asyncio.get_running_loop().call_later(TICK_SECONDS, self._tick_and_go_on)

    def _tick_and_go_on(self) -> None:
        self.tick()
        self._tick_later()


class Arrivals:
    """Of one connection, which has just been taken over from the kernel; nothing was sent over it yet."""

    def __init__(self, clock: LoopClock, connected: socket.socket) -> None:
        self._clock = clock
        self._waiting_since = _waiting_since(connected)

    def stamp(self, *, is_all: bool) -> int:
        """When what was read now arrived at the earliest, in ns of the wall clock.

        `is_all`: the kernel had no more. Otherwise what is read next is no newer.
        """
        since = self._waiting_since
        if since is None:
            since = self._clock.away_since()
        self._waiting_since = None if is_all else since
        return stamp(since)


def stamp(since: int | None) -> int:
    """The time of the wall clock now, or that of `since`, a monotonic time in ns."""
    return wall_ns() - (monotonic_ns() - since if since is not None else 0)


def _waiting_since(connected: socket.socket) -> int | None:
    """The monotonic time from which on something may be waiting in a connection that nobody took for long."""
    if fcntl.ioctl(connected.fileno(), termios.FIONREAD, bytes(4)) == bytes(4):
        return None
    now = monotonic_ns()
    information = connected.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _LAST_SENT.size)
    age_ns = _LAST_SENT.unpack(information)[0] * 1_000_000
    return now - age_ns if age_ns > AWAY_NS else None

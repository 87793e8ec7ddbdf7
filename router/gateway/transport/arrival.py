"""Arrival times of messages on streams.

The kernel does not timestamp streams. After a pause (a busy computer, a stopped process) old messages would look new,
so they count as arrived when the event loop last ran before the pause.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from router.clock import boottime_ns, wall_ns

TICK_SECONDS = 0.02

AWAY_NS = 50_000_000
"""A longer gap between two ticks counts as a pause of the loop."""

CATCH_UP_NS = 100_000_000
"""For this long after a pause, messages that are read may have arrived during the pause."""


class LoopClock:
    """Detects pauses of the event loop while it has users. `clock_ns` is the boot clock."""

    def __init__(self, clock_ns: Callable[[], int] = boottime_ns) -> None:
        self._clock_ns = clock_ns
        self._last_tick = 0
        self._left = 0
        self._caught_up = 0
        self._ticking: asyncio.TimerHandle | None = None
        self._users = 0

    def start(self, waited: int = 0) -> None:
        """Add a user. `waited`: how long (ns) messages of the first one may already have been waiting."""
        self._users += 1
        if self._ticking is None:
            self._last_tick = self._clock_ns() - waited
            self._tick_later()

    def stop(self) -> None:
        """Remove a user."""
        self._users -= 1
        if not self._users and self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None

    def stamp(self) -> int:
        """Return the earliest arrival (wall clock, ns) of a message that is read now. Thread-safe."""
        return wall_ns() - self.delay()

    def delay(self) -> int:
        """Return how long (ns) a message that is read now may have been waiting."""
        if self._ticking is None:
            return 0
        now = self._clock_ns()
        if now - self._last_tick > AWAY_NS:
            return now - self._last_tick
        return now - self._left if now < self._caught_up else 0

    def tick(self) -> None:
        """Record that the loop runs."""
        now = self._clock_ns()
        if now - self._last_tick > AWAY_NS:
            self._left, self._caught_up = self._last_tick, now + CATCH_UP_NS
        self._last_tick = now

    def _tick_later(self) -> None:
        self._ticking = asyncio.get_running_loop().call_later(TICK_SECONDS, self._on_timer)

    def _on_timer(self) -> None:
        self.tick()
        self._tick_later()

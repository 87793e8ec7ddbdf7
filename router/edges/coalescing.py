"""How long to let datagrams gather before looking at them, where they come so thick that this pays.

Waking up costs more than handling a datagram. Network cards moderate their interrupts for the same reason.
Knows numbers only: no socket, and no clock.
"""

from __future__ import annotations

from collections.abc import Callable

SAMPLE = 32
"""So many datagrams tell how thick they come."""

_THICK = 3
"""Datagrams in the longest rest, on average, that are worth it. With fewer, the timer costs what the wake-ups do."""

FOR_SUBSCRIBERS = 8
"""So many datagrams are enough for one look while anybody subscribes: ROS queues are commonly ten deep, and a longer
burst of one topic would overflow them."""

FOR_SOCKETS = 64
"""So many are enough where they only go to sockets, which hold hundreds."""

_SHORTEST = 150e-6
"""Seconds. A shorter rest costs what the wake-ups do that it saves."""


class Coalescing:
    """One listener's. `longest` is the longest rest in ns; 0 for none at all. `enough` tells how many may gather."""

    def __init__(self, longest: int, enough: Callable[[], int]) -> None:
        self._longest = longest / 1e9
        self._enough = enough
        self._rest = 0.0

    def begins(self, elapsed: int) -> bool:
        """Whether to rest from now on, because SAMPLE datagrams came in so many ns."""
        self._rest = elapsed / 1e9
        return elapsed / 1e9 * _THICK < self._longest * SAMPLE

    def rest(self, taken: int) -> float:
        """Seconds until the next look, after one that got so many datagrams. 0: not worth it any more."""
        if taken < 2:
            return 0.0
        self._rest = min(self._longest, self._rest * self._enough() / taken)
        return self._rest if self._rest >= min(self._longest, _SHORTEST) else 0.0

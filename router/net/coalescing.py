"""How long to let datagrams gather before looking at them, where they come so thick that this pays.

Waking up costs more than handling a datagram. Network cards moderate their interrupts for the same reason.
Knows numbers only: no socket, and no clock.
"""

from __future__ import annotations

from collections.abc import Callable

SAMPLE = 32
"""So many datagrams tell how thick they come."""

_THICK = 3
"""Datagrams in the longest rest, on average, with which resting begins. With fewer than two in a rest it ends."""

FOR_SUBSCRIBERS = 8
"""So many datagrams are enough for one look while anybody subscribes: ROS queues are commonly ten deep, and a longer
burst of one topic would overflow them."""

FOR_SOCKETS = 32
"""So many are enough where they only go to sockets, which hold hundreds."""

_SHORTEST = 150e-6
"""Seconds. A shorter rest costs what the wake-ups do that it saves."""


class Coalescing:
    """One listener's rests, in seconds; 0 means that each datagram is waited for.

    `longest` is the longest rest in ns; with 0 there is none. `enough` tells how many datagrams one look should get.
    """

    def __init__(self, longest: int, enough: Callable[[], int]) -> None:
        self._longest = longest / 1e9
        self._enough = enough
        self._rest = 0.0

    def first(self, elapsed: int) -> float:
        """The rest after SAMPLE datagrams that were waited for and came in so many ns."""
        self._rest = elapsed / 1e9
        return self.next(SAMPLE) if self._rest * _THICK < self._longest * SAMPLE else 0.0

    def next(self, taken: int) -> float:
        """The rest after a rest that ended with so many datagrams."""
        if taken < 2:
            return 0.0
        self._rest = min(self._longest, self._rest * self._enough() / taken)
        return self._rest if self._rest >= min(self._longest, _SHORTEST) else 0.0

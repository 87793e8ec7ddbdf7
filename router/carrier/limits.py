"""Age and rate limits for messages that Python handles, with the functions of the native threads."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

from router import declared as c
from router.carrier.owned import open_native
from router.image.openings import period

_UNKNOWN = -(1 << 63)


class TimeRange(NamedTuple):
    """`struct time_range` in freshness.h: the earliest and latest possible time of a stamp, in ns of the boot clock."""

    oldest: int
    youngest: int


class Freshness:
    """`struct freshness`: tracks the jumps of the wall clock. Not thread-safe."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._structure = c.Freshness()
        self._at = ctypes.addressof(self._structure)
        self._times = library.freshness_times

    def times(self, stamp: int, received_at: int, now: int, not_before: int | None = None) -> TimeRange:
        """Return the possible times of an event with the wall-clock stamp `stamp`, never after `now`.

        `now` (boot clock) and `received_at` (wall clock) are the present time in ns, read in this order. The event did
        not happen before `not_before` (boot clock); None if that is not known.
        """
        found = self._times(self._at, stamp, received_at, now, _UNKNOWN if not_before is None else not_before)
        return TimeRange(found.oldest, found.youngest)


class RateLimit:
    """`struct limit`, for one thread at a time: passes at most `hertz` messages per second."""

    def __init__(self, library: ctypes.CDLL, hertz: float) -> None:
        self._at = open_native(library, "limit_open", period(hertz))
        self._close = library.limit_close
        self._passes = library.limit_passes

    def may_pass(self, now: int) -> bool:
        """Return whether a message may pass now (boot clock, ns), and if so, count it against the limit."""
        return bool(self._passes(self._at, now))

    def __del__(self) -> None:
        self._close(self._at)

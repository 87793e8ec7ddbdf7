"""`max_rate`: which messages of a stream may pass so that the rate is right on average."""

from __future__ import annotations

from math import ceil

NS = 1_000_000_000


class RateLimit:
    """Lets through at most `hertz` messages per second; all times are monotonic, in ns.

    Passes keep to a grid of one period. A message up to half a period early takes its place on the grid (an
    interval throttle would wait for the next and undershoot: 25 instead of 30 Hz out of 100); after a pause
    the grid starts anew, so nothing is saved up for a burst. In any second at most `hertz` + 1 pass.

    `next_pass` is the time from which on a message may pass.
    """

    __slots__ = ("_late", "_period", "next_pass")

    def __init__(self, hertz: float) -> None:
        self._period = ceil(NS / hertz)
        self._late = self._period - self._period // 2
        self.next_pass = -self._period  # a whole period ago at any time, for monotonic time is not negative

    def may_pass(self, now: int) -> bool:
        """Whether a message may pass now; if so, it has taken the place."""
        waited = now - self.next_pass
        if waited < 0:
            return False
        self.next_pass = self.next_pass + self._period if waited < self._period else now + self._late
        return True

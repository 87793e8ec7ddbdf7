"""The oracle of ages and rates: a slow and plain version of the rules in `freshness.h` and `limit.h`."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil

from router.carrier.limits import TimeRange

TOLERANCE, MEMORY, MOST_SETTINGS = 10_000_000, 10_000_000_000, 32


@dataclass
class Freshness:
    """`settings` are earlier settings of the wall clock: its offset, and the longest period in which it applied."""

    settings: list[tuple[int, int, int]] = field(default_factory=list)
    now: tuple[int, int, int] | None = None
    """The current offset, the earliest time it can apply from, and the time it was last observed."""

    def look(self, received_at: int, now: int) -> None:
        offset = received_at - now
        if self.now is None:
            self.now = offset, 0, now
            return
        before, since, seen = self.now
        if abs(offset - before) > TOLERANCE // 2:
            self.settings = [*self.settings, (before, since, now)][-MOST_SETTINGS:]
            before, since = offset, seen
        self.now = before, since, now

    def times(self, stamp: int, received_at: int, now: int, not_before: int | None = None) -> TimeRange:
        self.look(received_at, now)
        assert self.now is not None
        while self.settings and now - self.settings[0][2] > MEMORY:
            self.settings = self.settings[1:]
        event = stamp - (received_at - now)
        candidates = [(stamp - offset, since, until) for offset, since, until in self.settings]
        candidates.append((event, self.now[1], now))
        possible = [at for at, since, until in candidates if since - TOLERANCE <= at <= until + TOLERANCE]
        if not possible or not self.settings:
            possible = [event]
        in_order = [at for at in possible if not_before is not None and at >= not_before - TOLERANCE]
        return TimeRange(min(*(in_order or possible), now), min(max(possible), now))


class RateLimit:
    def __init__(self, hertz: float) -> None:
        self._period = ceil(1_000_000_000 / hertz)
        self.next_pass = -self._period

    def may_pass(self, now: int) -> bool:
        if now < self.next_pass:
            return False
        is_on_the_grid = now < self.next_pass + self._period
        self.next_pass = self.next_pass + self._period if is_on_the_grid else now + self._period - self._period // 2
        return True

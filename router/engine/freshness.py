"""Converts a time stamp of the wall clock, which may have jumped since, to the monotonic clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

TOLERANCE = 10_000_000
"""Error in ns of a time that `born` returns while the wall clock is slewed, at up to 1 ms/s."""

MEMORY = 10_000_000_000
"""ns for which a past setting of the wall clock is remembered after the next one was detected."""

_MOST_SETTINGS = 32


@dataclass(frozen=True, slots=True)
class _Setting:
    """The wall clock was `offset` ahead of the monotonic one, at most from `since` until `until`."""

    offset: int
    since: int
    until: int


class Freshness:
    """Follows the wall clock through its jumps. For one thread, which calls `born` with every stamp.

    Each call compares the wall clock with the monotonic one. If the offset has changed, the clock was set since the
    last call. A stamp means a different time under each setting, but only times at which that setting may have been in
    force are possible; of these the latest is taken.

    Provided that the clock was set at most once between two calls, and that stamps come from clocks that are set
    together with ours, it follows for an event of the last MEMORY, within TOLERANCE:

    - It is never taken to be older than it is: no jump makes a fresh message stale.
    - It is taken to be younger than it is only if the wall clock was set since, or since the last call before it, by
      some `d` no greater than its age: then it may pass for `d` younger. A message that is stale by 2 s is taken for
      fresh if the clock was set by about 2 s while it was under way or in the silence before it, and not if it was set
      by more or less, or earlier. Such a stamp is ambiguous: a clock that is set back shows the same time twice.
      Taking the earlier time would refuse every message for `d` after the clock was set back by `d`.

    An older event may be taken for any age if the clock was set since.

    A stamp in the future under all settings comes from a computer whose clock is ahead; it counts as now. For MEMORY
    after our clock was set back by more than theirs is ahead, it is instead taken for a stamp from before that.
    """

    def __init__(self) -> None:
        self._offset: int | None = None
        self._since = 0
        self._seen = 0
        self._past: deque[_Setting] = deque(maxlen=_MOST_SETTINGS)

    def born(self, stamp: int, received_at: int, now: int) -> int:
        """Return the monotonic time in ns of an event stamped `stamp` (wall clock, ns); never after `now`.

        `now` and `received_at` are the monotonic and the wall clock, read now in this order: a pause between
        makes events older, not younger.
        """
        offset = received_at - now
        if self._offset is None:
            self._offset = offset
        elif abs(offset - self._offset) > TOLERANCE // 2:
            self._past.append(_Setting(self._offset, self._since, now))
            self._offset, self._since = offset, self._seen
        self._seen = now
        event = stamp - offset
        if self._past:
            event = self._latest_possible(stamp, event, now)
        return min(event, now)

    def _latest_possible(self, stamp: int, event: int, now: int) -> int:
        """`event` is what the stamp means under the present setting."""
        while self._past and now - self._past[0].until > MEMORY:
            self._past.popleft()
        settings = [(stamp - past.offset, past.since, past.until) for past in self._past]
        settings.append((event, self._since, now))
        possible = [time for time, since, until in settings if since - TOLERANCE <= time <= until + TOLERANCE]
        return max(possible, default=event)

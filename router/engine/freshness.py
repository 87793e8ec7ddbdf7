"""When something happened on the monotonic clock, from a stamp of the wall clock that may have jumped since.

Reads no clock: whoever calls tells both.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

TOLERANCE = 10_000_000
"""ns by which wall clock minus monotonic clock may wander (slewing, a pause between reading one and the other)."""

MEMORY = 10_000_000_000
"""ns for which a past setting of the wall clock is remembered after the next one was noticed."""

_MOST_SETTINGS = 32


@dataclass(frozen=True, slots=True)
class _Setting:
    """A wall clock that was `offset` ahead of the monotonic one, not before `since` and not after `until`."""

    offset: int
    since: int
    until: int


class Freshness:
    """Follows the wall clock through its jumps. For one thread, which calls `born` with every stamp.

    Each call tells how far the wall clock is ahead of the monotonic one. Where that has changed by more than
    TOLERANCE since the last call, the clock was set in between. A stamp means a different time under each
    setting, but only a time at which that setting may have been in force can be right; of several such times
    the latest is taken.

    Provided that the clock was set at most once between two calls, and that the stamp was made by a clock
    that is set together with ours, it follows, within TOLERANCE:

    - An event is never taken to be older than it is: no jump makes a fresh message stale.
    - An event is taken to be younger than it is only if the wall clock has shown the stamped time twice, by being
      set back since: by `d`, for an event at least `d` ago, which then counts as `d` younger. So a message
      that is stale by 2 s passes for fresh if the clock was set back by about 2 s on its way, and not if it was set
      back by another amount, set forward, or set before the message was stamped. A stamp alone cannot tell these
      two times apart, and taking the earlier one would refuse every message for `d` after such a jump.
    - A message that was under way for longer than MEMORY when the clock was set back counts as just made.

    A stamp in the future under all settings is that of another computer whose clock is ahead; it counts as
    now. For MEMORY after our clock was set back by more than theirs is ahead, it is instead taken for one made before.
    """

    def __init__(self) -> None:
        self._offset: int | None = None
        self._since = 0
        self._seen = 0
        self._past: deque[_Setting] = deque(maxlen=_MOST_SETTINGS)

    def born(self, stamp: int, received_at: int, now: int) -> int:
        """The monotonic time in ns of the event that was stamped `stamp` (ns of the wall clock); never after `now`.

        `now` and `received_at` are the monotonic and the wall clock, read now in this order: a pause between
        makes events older, not younger.
        """
        offset = received_at - now
        if self._offset is None:
            self._offset = offset
        elif abs(offset - self._offset) > TOLERANCE:
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

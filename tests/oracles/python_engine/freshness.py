"""When a message was born by the boot clock: its time stamp is of the wall clock, which may have been set since."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

TOLERANCE = 10_000_000
"""Error in ns of a time that `born` returns while the wall clock is slewed, at up to 1 ms/s."""

MEMORY = 10_000_000_000
"""ns for which a past setting of the wall clock is remembered after the next one was detected."""

_MOST_SETTINGS = 32


class Born(NamedTuple):
    """When a message was born, by the boot clock (ns): the earliest and the latest time that its stamp can mean."""

    oldest: int
    youngest: int

    def or_before(self, other: Born) -> Born:
        return Born(min(self.oldest, other.oldest), min(self.youngest, other.youngest))


@dataclass(frozen=True, slots=True)
class _Setting:
    """The wall clock was `offset` ahead of the boot clock, at most from `since` until `until`."""

    offset: int
    since: int
    until: int


class Freshness:
    """Follows the wall clock through its jumps. For one thread.

    Each look compares the wall clock with the boot clock. If the offset has changed, the clock was set since the last
    look. A stamp means a different time under each setting, but only times at which that setting may have been in
    force are possible. While several are, the stamp is ambiguous: a clock that is set back shows the same time twice.

    Provided that the clock was set at most once between two looks, and that stamps come from clocks that are set
    together with ours, it follows for an event of the last MEMORY, within TOLERANCE:

    - The oldest reading is never younger than the event: what is stale by it stays so whatever is done to the clock.
      For a while after the clock was set back by `d`, it takes fresh messages for `d` older, unless it is known that
      they cannot be: by `not_before`, or because the past was forgotten.
    - The youngest reading is never older than the event: no jump makes a fresh message stale by it. It is younger only
      if the clock was set since, or since the last look before the event, by some `d` no greater than its age.

    An older event may be taken for any age if the clock was set since.

    A stamp in the future under all settings comes from a computer whose clock is ahead; it counts as now. For MEMORY
    after our clock was set back by more than theirs is ahead, it is instead taken for a stamp from before that.
    """

    def __init__(self) -> None:
        self.past: deque[_Setting] = deque(maxlen=_MOST_SETTINGS)
        """Past settings under which a message that is still to come may have been stamped."""
        self._offset: int | None = None
        self._since = 0
        self._seen = 0

    def look(self, received_at: int, now: int) -> None:
        """Compare the clocks. Look often also while nothing is stamped: that bounds when the clock can have been set.

        `now` and `received_at` are the boot clock and the wall clock, read now in this order: a pause between makes
        events older, not younger.
        """
        offset = received_at - now
        if self._offset is None:
            self._offset = offset
        elif abs(offset - self._offset) > TOLERANCE // 2:
            self.past.append(_Setting(self._offset, self._since, now))
            self._offset, self._since = offset, self._seen
        self._seen = now

    def forget_past(self) -> None:
        """Nothing that is still to come was stamped before the last look: the queue was found empty since."""
        self.past.clear()

    def born(self, stamp: int, received_at: int, now: int, not_before: int | None = None) -> Born:
        """Look, and return when an event stamped `stamp` (wall clock, ns) was; never after `now`.

        It was not before `not_before` (boot clock), if that is known; else None.
        """
        self.look(received_at, now)
        event = stamp - (received_at - now)
        if not self.past:
            return Born(min(event, now), min(event, now))
        possible = self._possible(stamp, event, now)
        in_order = [time for time in possible if not_before is not None and time >= not_before - TOLERANCE]
        return Born(min(*(in_order or possible), now), min(max(possible), now))

    def _possible(self, stamp: int, event: int, now: int) -> list[int]:
        """`event` is what the stamp means under the present setting."""
        while self.past and now - self.past[0].until > MEMORY:
            self.past.popleft()
        settings = [(stamp - past.offset, past.since, past.until) for past in self.past]
        settings.append((event, self._since, now))
        possible = [time for time, since, until in settings if since - TOLERANCE <= time <= until + TOLERANCE]
        return possible or [event]

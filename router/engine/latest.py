"""`keep: latest`: what `max_rate` holds back is not lost, its newest message goes as soon as the rate allows."""

from __future__ import annotations

from router.engine.delivery import Deliver, is_stale
from router.engine.limiter import RateLimit
from router.engine.machine import Machine
from router.engine.outcome import Outcome


class Latest(Machine):
    """Delivers at most `hertz` messages per second. Holds one at most: the newest, until it may pass.

    One that a newer one replaces is dropped as `rate_limited`, one that gets too old meanwhile as `stale`.
    """

    def __init__(self, hertz: float, deliver: Deliver, outcome: Outcome) -> None:
        self.next_due: int | None = None
        self._limit = RateLimit(hertz)
        self._deliver = deliver
        self._outcome = outcome
        self._held: tuple[bytes, int | None] | None = None

    def offer(self, now: int, data: bytes, expires: int | None) -> None:
        """A Deliver: hands the message on now or later."""
        if self._held is not None:
            self._outcome.dropped("rate_limited")
        if self._limit.may_pass(now):
            self._release()
            self._deliver(now, data, expires)
        else:
            self._held = (data, expires)
            self.next_due = self._limit.next_pass

    def due(self, now: int) -> None:
        if self._held is not None and (is_stale(now, self._held[1]) or self._limit.may_pass(now)):
            self.end(now)

    def end(self, now: int) -> None:
        """Delivers what is held, ahead of its time, unless that has passed."""
        if self._held is None:
            return
        data, expires = self._held
        self._release()
        if is_stale(now, expires):
            self._outcome.dropped("stale")
        else:
            self._deliver(now, data, expires)

    def _release(self) -> None:
        self._held = self.next_due = None

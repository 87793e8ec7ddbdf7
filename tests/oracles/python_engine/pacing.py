"""`max_rate`, `on_limit: latest` and `bandwidth`: which messages pass, which wait and which are dropped."""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from math import ceil
from typing import NamedTuple

from router.table.model import Priority
from tests.oracles.python_engine.delivery import Command, Deliver, Outcome, Place, immediately, is_stale
from tests.oracles.python_engine.timers import Timer

NS = 1_000_000_000

BURST = NS // 50
"""What a pause saves up, as the time (ns) in which the budget earns it."""

OVERDRAFT, LEAST_OVERDRAFT = NS // 10, 2048
"""What commands may overdraw the budget: as time (ns), and in bytes where the budget is so small that this is more."""

QUEUE, LEAST_QUEUE = NS, 65536
"""What may wait: as time (ns), and in bytes where that is more."""


class RateLimit:
    """Passes at most `hertz` messages per second; all times are of the boot clock, in ns.

    Passes keep to a grid of one period. A message up to half a period early takes its place on the grid (a limiter by
    interval would wait for the next and undershoot: 25 instead of 30 Hz out of 100); after a pause the grid starts
    anew, so nothing is saved up for a burst. At most `hertz` + 1 messages pass in any second.

    `next_pass` is the time from which on a message may pass.
    """

    __slots__ = ("_late", "_period", "next_pass")

    def __init__(self, hertz: float) -> None:
        self._period = self.period(hertz)
        self._late = self._period - self._period // 2
        self.next_pass = -self._period  # a whole period ago at any time, because the boot clock is not negative

    @staticmethod
    def period(hertz: float) -> int:
        """The period of the grid in ns."""
        return ceil(NS / hertz)

    def may_pass(self, now: int) -> bool:
        """Whether a message may pass now; if so, it takes the place."""
        waited = now - self.next_pass
        if waited < 0:
            return False
        self.next_pass = self.next_pass + self._period if waited < self._period else now + self._late
        return True


class Latest(Timer):
    """Delivers at most `hertz` messages per second, and holds the newest of those in between until it may pass.

    A held message is dropped as `rate_limited` when a newer one replaces it, as `stale` when it expires.
    """

    def __init__(self, hertz: float, deliver: Deliver, outcome: Outcome) -> None:
        self.next_due: int | None = None
        self._limit = RateLimit(hertz)
        self._deliver = deliver
        self._outcome = outcome
        self._held: tuple[bytes, int | None] | None = None

    def offer(self, now: int, data: bytes, expires: int | None) -> None:
        """A Deliver: hand the message on now or later."""
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
        """Deliver the held message early, unless it has expired."""
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


class _Waiting(NamedTuple):
    """A queued datagram. `cost` is the time (ns) in which the budget earns `data`."""

    outcome: Outcome
    send: Deliver
    data: bytes
    expires: int | None
    cost: int


class Pacer(Timer):
    """Sends to one endpoint, on average at most `bytes_per_second` of UDP payload, as in `sent_bytes`.

    Datagrams that are no commands leave only when the budget for them is saved up, so they never overdraw it. At most
    BURST is saved up, and beyond that the cost of the first datagrams that wait: the longest datagram passes the
    smallest budget. A command leaves as long as no earlier command waits and the budget is overdrawn by the overdraft
    at most: it waits for commands only, and all others wait until the overdraft is paid.

    Waiting datagrams leave by priority, then by age. When more waits than the queue holds, the oldest of the lowest
    priority is dropped as `queue_full`; what expires in the queue is dropped as `stale`. A datagram is charged also if
    sending it fails.
    """

    def __init__(self, bytes_per_second: int) -> None:
        self.next_due: int | None = None
        self._rate = bytes_per_second
        self._overdraft = max(OVERDRAFT, self._cost(LEAST_OVERDRAFT))
        self._lanes: dict[Priority, deque[_Waiting]] = {priority: deque() for priority in Priority}
        self._commands = self._lanes[Priority.COMMAND]
        self._others = [lane for lane in self._lanes.values() if lane is not self._commands]
        self._room = max(bytes_per_second * QUEUE // NS, LEAST_QUEUE)
        self._paid_at = -BURST  # when the budget has paid for all that was sent; what lies before now is saved up

    def queue(self, priority: Priority, outcome: Outcome, command: Command) -> Deliver:
        """Return the Deliver of one target, which sends by `command` now or later, or drops."""
        lane, send = self._lanes[priority], immediately(command, outcome)

        def deliver(now: int, data: bytes, expires: int | None) -> None:
            self._limit_savings(now)
            lane.append(_Waiting(outcome, send, data, expires, self._cost(len(data))))
            self._room -= len(data)
            self._send_affordable(now)
            while self._room < 0:
                self._drop_one()

        return deliver

    def due(self, now: int) -> None:
        self._limit_savings(now)
        self._send_affordable(now)

    def end(self, now: int) -> None:
        """Send all that waits, whatever the budget: at most what the queue holds."""
        self.next_due = None
        for lane in self._lanes.values():
            while lane:
                self._send_first(lane, now)

    def keep_only(self, now: int, places: Container[Place]) -> None:
        """Send what waits for targets other than `places`, whatever the budget, as their counters will be gone."""
        self._limit_savings(now)
        for lane in self._lanes.values():
            for _ in range(len(lane)):
                if lane[0].outcome.place in places:
                    lane.rotate(-1)
                else:
                    self._send_first(lane, now)

    def _send_affordable(self, now: int) -> None:
        self.next_due = None
        for lane in self._lanes.values():
            while lane:
                expires, cost = lane[0][3:]
                may_go_at = self._paid_at + (-self._overdraft if lane is self._commands else cost)
                if now < may_go_at and not is_stale(now, expires):
                    self.next_due = may_go_at + BURST // 2  # later than necessary: one call then sends several
                    if expires is not None:  # an expired datagram no longer counts in the savings
                        self.next_due = min(self.next_due, expires + 1)
                    return
                self._send_first(lane, now)

    def _send_first(self, lane: deque[_Waiting], now: int) -> None:
        outcome, send, data, expires, cost = lane.popleft()
        self._room += len(data)
        if is_stale(now, expires):
            outcome.dropped("stale")
            self._limit_savings(now)
        else:
            self._paid_at += cost
            send(now, data, expires)

    def _limit_savings(self, now: int) -> None:
        """Cap what is saved up. To be called before the first datagram of a lane changes."""
        first = 0
        for lane in self._others:
            if lane and lane[0].cost > first:
                first = lane[0].cost
        self._paid_at = max(self._paid_at, now - BURST - first)

    def _drop_one(self) -> None:
        lowest = next(lane for lane in reversed(self._lanes.values()) if lane)
        dropped = lowest.popleft()
        self._room += len(dropped.data)
        dropped.outcome.dropped("queue_full")

    def _cost(self, size: int) -> int:
        """The time in ns in which the budget earns `size` bytes."""
        return -(-size * NS // self._rate)

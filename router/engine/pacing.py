"""`budget`: how fast datagrams go to one endpoint, and which of them wait or are dropped when that is too slow."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container
from typing import NamedTuple

from router.engine.delivery import Deliver, immediately, is_stale
from router.engine.limiter import NS
from router.engine.machine import Machine
from router.engine.outcome import Outcome, Place
from router.table.model import Priority

BURST = NS // 50
"""What may be sent at once after a pause, as the time (ns) that the budget takes for it."""

OVERDRAFT, LEAST_OVERDRAFT = NS // 10, 2048
"""What commands may go beyond that: as time (ns), and in bytes where the budget is so small that this is more."""

QUEUE, LEAST_QUEUE = NS, 65536
"""What may wait: as time (ns), and in bytes where that is more."""


class _Waiting(NamedTuple):
    outcome: Outcome
    send: Deliver
    data: bytes
    expires: int | None


class _Lane(NamedTuple):
    """What waits of one priority. It may go when at most `ahead` ns of budget are used up in advance."""

    ahead: int
    waiting: deque[_Waiting]


class Pacer(Machine):
    """Sends to one endpoint, on average at most `bytes_per_second` of datagrams.

    Bytes are those of `sent_bytes`; what UDP, IP and the link put around a datagram (28 bytes and more) comes on
    top. A datagram may go as long as at most BURST was sent ahead of the budget, so that the longest one goes
    through the smallest budget, and pays for itself by the pause after it.

    What has to wait goes by priority, within one by age. A command does not wait for what others have used up,
    as long as no earlier command waits and commands are not more than the overdraft ahead of the budget; the others
    then wait until that is paid. When more waits than the queue holds, the oldest of the lowest priority
    is dropped as `queue_full`; what is too old when its turn comes as `stale`.

    `send` may raise OSError; what it refuses has used up its share all the same.
    """

    def __init__(self, bytes_per_second: int, send: Callable[[bytes], int]) -> None:
        self.next_due: int | None = None
        self._rate = bytes_per_second
        self._send = send
        overdraft = max(OVERDRAFT, self._time_of(LEAST_OVERDRAFT))
        self._lanes = {
            priority: _Lane(BURST + overdraft if priority is Priority.COMMAND else BURST, deque())
            for priority in Priority
        }
        self._room = max(bytes_per_second * QUEUE // NS, LEAST_QUEUE)
        self._paid_at = 0  # when the budget will have made up for all that was sent

    def queue(self, priority: Priority, outcome: Outcome) -> Deliver:
        """The way to the endpoint for one target: sends now or later, or drops."""
        waiting, send = self._lanes[priority].waiting, immediately(self._send, outcome)

        def deliver(now: int, data: bytes, expires: int | None) -> None:
            waiting.append(_Waiting(outcome, send, data, expires))
            self._room -= len(data)
            self.due(now)
            while self._room < 0:
                self._drop_one()

        return deliver

    def due(self, now: int) -> None:
        self.next_due = None
        for lane in self._lanes.values():
            while lane.waiting:
                may_go_at = self._paid_at - lane.ahead
                if now < may_go_at:
                    self.next_due = may_go_at + BURST // 2  # later than it may: one call then sends several
                    return
                self._send_first(lane, now)

    def end(self, now: int) -> None:
        """Sends what waits, whatever the budget: that is no more than the queue holds."""
        self.next_due = None
        for lane in self._lanes.values():
            while lane.waiting:
                self._send_first(lane, now)

    def serve_only(self, now: int, places: Container[Place]) -> None:
        """Sends what waits for other targets, whatever the budget: later, nobody would count it."""
        for lane in self._lanes.values():
            for _ in range(len(lane.waiting)):
                if lane.waiting[0].outcome.place in places:
                    lane.waiting.rotate(-1)
                else:
                    self._send_first(lane, now)

    def _send_first(self, lane: _Lane, now: int) -> None:
        outcome, send, data, expires = lane.waiting.popleft()
        self._room += len(data)
        if is_stale(now, expires):
            outcome.dropped("stale")
        else:
            self._paid_at = max(self._paid_at, now) + self._time_of(len(data))
            send(now, data, expires)

    def _drop_one(self) -> None:
        lowest = next(lane for lane in reversed(self._lanes.values()) if lane.waiting)
        dropped = lowest.waiting.popleft()
        self._room += len(dropped.data)
        dropped.outcome.dropped("queue_full")

    def _time_of(self, size: int) -> int:
        """How long the budget takes for `size` bytes, in ns."""
        return -(-size * NS // self._rate)

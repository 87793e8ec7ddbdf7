"""`budget`: how fast datagrams go to one endpoint, and which of them wait or are dropped when that is too slow."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container
from typing import NamedTuple

from router.engine.delivery import Deliver, Feed, immediately, is_stale
from router.engine.limiter import NS
from router.engine.machine import Machine
from router.engine.outcome import Outcome, Place
from router.table.model import Priority

BURST = NS // 50
"""What is saved up in a pause, as the time (ns) that the budget takes for it."""

OVERDRAFT, LEAST_OVERDRAFT = NS // 10, 2048
"""What commands may overdraw the budget: as time (ns), and in bytes where the budget is so small that this is more."""

QUEUE, LEAST_QUEUE = NS, 65536
"""What may wait: as time (ns), and in bytes where that is more."""


class _Waiting(NamedTuple):
    """`takes` is the time (ns) that the budget takes for `data`."""

    outcome: Outcome
    send: Deliver
    data: bytes
    expires: int | None
    takes: int


class Pacer(Machine):
    """Sends to one endpoint, on average at most `bytes_per_second` of datagrams.

    Bytes are those of `sent_bytes`; what UDP, IP and the link put around a datagram (28 bytes and more) comes on
    top.

    What is not a command leaves only when the budget for it has been saved up, so it never overdraws the budget. BURST
    is saved up at most, and beyond that what the first datagrams that wait will take: so the longest datagram goes
    through the smallest budget. A command leaves as long as no earlier command waits and the budget is overdrawn by the
    overdraft at most. So a command waits for commands only; all others wait until the overdraft is paid.

    What has to wait goes by priority, within one by age. When more waits than the queue holds, the oldest of the lowest
    priority is dropped as `queue_full`; what is too old when it waits first as `stale`.

    `send` may raise OSError; what it refuses has used up its share all the same.
    """

    def __init__(self, bytes_per_second: int, send: Callable[[bytes], int]) -> None:
        self.next_due: int | None = None
        self._rate = bytes_per_second
        self._send = send
        self._overdraft = max(OVERDRAFT, self._time_of(LEAST_OVERDRAFT))
        self._lanes: dict[Priority, deque[_Waiting]] = {priority: deque() for priority in Priority}
        self._commands = self._lanes[Priority.COMMAND]
        self._others = [lane for lane in self._lanes.values() if lane is not self._commands]
        self._room = max(bytes_per_second * QUEUE // NS, LEAST_QUEUE)
        self._paid_at = -BURST  # when the budget has paid for all that was sent; what lies before now is saved up

    def queue(self, priority: Priority, outcome: Outcome, feed: Feed | None = None) -> Deliver:
        """The way to the endpoint for one target: sends now or later, or drops. `feed` is as in `immediately`."""
        lane, send = self._lanes[priority], immediately(self._send, outcome, feed=feed)

        def deliver(now: int, data: bytes, expires: int | None) -> None:
            self._forfeit(now)
            lane.append(_Waiting(outcome, send, data, expires, self._time_of(len(data))))
            self._room -= len(data)
            self._serve(now)
            while self._room < 0:
                self._drop_one()

        return deliver

    def due(self, now: int) -> None:
        self._forfeit(now)
        self._serve(now)

    def _serve(self, now: int) -> None:
        self.next_due = None
        for lane in self._lanes.values():
            while lane:
                expires, takes = lane[0][3:]
                may_go_at = self._paid_at + (-self._overdraft if lane is self._commands else takes)
                if now < may_go_at and not is_stale(now, expires):
                    self.next_due = may_go_at + BURST // 2  # later than it may: one call then sends several
                    if expires is not None:  # nothing is saved up for what is too old
                        self.next_due = min(self.next_due, expires + 1)
                    return
                self._send_first(lane, now)

    def end(self, now: int) -> None:
        """Sends what waits, whatever the budget: that is no more than the queue holds."""
        self.next_due = None
        for lane in self._lanes.values():
            while lane:
                self._send_first(lane, now)

    def serve_only(self, now: int, places: Container[Place]) -> None:
        """Sends what waits for other targets, whatever the budget: later, nobody would count it."""
        self._forfeit(now)
        for lane in self._lanes.values():
            for _ in range(len(lane)):
                if lane[0].outcome.place in places:
                    lane.rotate(-1)
                else:
                    self._send_first(lane, now)

    def _send_first(self, lane: deque[_Waiting], now: int) -> None:
        outcome, send, data, expires, takes = lane.popleft()
        self._room += len(data)
        if is_stale(now, expires):
            outcome.dropped("stale")
            self._forfeit(now)
        else:
            self._paid_at += takes
            send(now, data, expires)

    def _forfeit(self, now: int) -> None:
        """Limits what is saved up. To be called before others wait first than did until now."""
        first = 0
        for lane in self._others:
            if lane and lane[0].takes > first:
                first = lane[0].takes
        self._paid_at = max(self._paid_at, now - BURST - first)

    def _drop_one(self) -> None:
        lowest = next(lane for lane in reversed(self._lanes.values()) if lane)
        dropped = lowest.popleft()
        self._room += len(dropped.data)
        dropped.outcome.dropped("queue_full")

    def _time_of(self, size: int) -> int:
        """How long the budget takes for `size` bytes, in ns."""
        return -(-size * NS // self._rate)

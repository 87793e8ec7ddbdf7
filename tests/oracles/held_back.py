"""The oracle of held-back messages: a slow and plain version of the rules in `defer.h` and `pace.h`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from tests.oracles.ages_and_rates import RateLimit

NS = 1_000_000_000
BURST = NS // 50
OVERDRAFT, LEAST_OVERDRAFT = NS // 10, 2048
LEAST_ROOM, MOST_ROOM, BYTES_PER_DATAGRAM = 65536, 1 << 24, 16

Fate = Callable[[int, "Message", str], None]
"""Called with the time, a message and its outcome: "sent", or the reason of the drop."""


@dataclass(frozen=True)
class Message:
    """`expires` is None for no expiry. `rank` is the rank of its priority, commands first. `arrived` is a time."""

    number: int
    target: object
    size: int = 0
    expires: int | None = None
    rank: int = 0
    arrived: int = 0

    def is_stale(self, now: int) -> bool:
        return self.expires is not None and now > self.expires


class Pacer:
    def __init__(self, bandwidth: int, fate: Fate) -> None:
        self._bandwidth = bandwidth
        self._fate = fate
        self._waiting: list[Message] = []
        self._superseded: set[int] = set()
        """Numbers of messages that are lost already, but take room until they are the first."""
        self._paid_at = -BURST
        self.has_ended = False
        self.next_due: int | None = None

    def cost(self, size: int) -> int:
        return -(-size * NS // self._bandwidth)

    def offer(self, now: int, message: Message) -> None:
        if self.has_ended:
            self._fate(now, message, "stale" if message.is_stale(now) else "sent")
            return
        self._limit_savings(now)
        self._waiting.append(message)
        self._send_affordable(now)
        room = min(max(self._bandwidth, LEAST_ROOM), MOST_ROOM)
        while sum(each.size for each in self._waiting) > room or len(self._waiting) > room // BYTES_PER_DATAGRAM:
            lowest = max(each.rank for each in self._waiting)
            oldest = next(each for each in self._waiting if each.rank == lowest)
            self._waiting.remove(oldest)
            if oldest.number not in self._superseded:
                self._fate(now, oldest, "queue_full")

    def serve(self, now: int) -> None:
        self._limit_savings(now)
        self._send_affordable(now)

    def release(self, now: int, leaves: Callable[[Message], bool]) -> None:
        self._limit_savings(now)
        for each in sorted(filter(leaves, self._waiting), key=lambda each: each.rank):
            self._send(now, each)
        self._limit_savings(now)

    def supersede(self, now: int, before: int, target: object) -> None:
        lost = [each for each in self._waiting if each.target == target and each.number not in self._superseded]
        for each in sorted(lost, key=lambda each: each.rank):
            if each.arrived <= before:
                self._superseded.add(each.number)
                self._fate(now, each, "superseded")
        if any(each.target == target for each in self._waiting):
            self.next_due = now

    def end(self, now: int) -> None:
        """Send all queued messages, regardless of the bandwidth."""
        self.has_ended, self.next_due = True, None
        for each in sorted(self._waiting, key=lambda each: each.rank):
            self._send(now, each)

    def _first(self, rank: int) -> Message | None:
        return next((each for each in self._waiting if each.rank == rank), None)

    def _limit_savings(self, now: int) -> None:
        costs = [self.cost(first.size) for rank in (1, 2) if (first := self._first(rank))]
        self._paid_at = max(self._paid_at, now - BURST - max(costs, default=0))

    def _send_affordable(self, now: int) -> None:
        self.next_due = None
        overdraft = max(OVERDRAFT, self.cost(LEAST_OVERDRAFT))
        for rank in range(3):
            while (first := self._first(rank)) is not None:
                may_go_at = self._paid_at + (self.cost(first.size) if rank else -overdraft)
                is_lost = first.is_stale(now) or first.number in self._superseded
                if now < may_go_at and not is_lost:
                    ends = [] if first.expires is None else [first.expires + 1]
                    self.next_due = min([may_go_at, *ends])
                    return
                self._send(now, first)
                if is_lost:
                    self._limit_savings(now)

    def _send(self, now: int, message: Message) -> None:
        self._waiting.remove(message)
        if message.number in self._superseded:
            return
        if message.is_stale(now):
            self._fate(now, message, "stale")
        else:
            self._paid_at += self.cost(message.size)
            self._fate(now, message, "sent")


@dataclass(eq=False)
class Deferral:
    """`hertz` is the rate with `on_limit: latest`, else None. Messages that pass go to `pacer`, if there is one."""

    hertz: float | None
    pacer: Pacer | None
    fate: Fate
    held: Message | None = None
    has_ended: bool = False
    next_due: int | None = None
    limit: RateLimit = field(init=False)

    def __post_init__(self) -> None:
        self.limit = RateLimit(self.hertz or 1)

    def offer(self, now: int, message: Message) -> None:
        if self.hertz is None or self.has_ended:
            self._pass_on(now, message)
            return
        if self.held is not None:
            self.fate(now, self.held, "rate_limited")
        self.held = self.next_due = None
        if self.limit.may_pass(now):
            self._pass_on(now, message)
        else:
            self.held, self.next_due = message, self.limit.next_pass

    def serve(self, now: int) -> None:
        if self.held is not None and (self.held.is_stale(now) or self.limit.may_pass(now)):
            self._release(now)

    def supersede(self, now: int, before: int, target: object) -> None:
        """Drop what arrived before a command of a route that takes over."""
        if self.held is not None and self.held.arrived <= before:
            held, self.held, self.next_due = self.held, None, None
            self.fate(now, held, "superseded")
        if self.pacer is not None:
            self.pacer.supersede(now, before, target)

    def change(self, now: int, hertz: float | None) -> None:
        """Reload. If the rate changes, send the held message now."""
        if hertz != self.hertz:
            self._release(now)
            self.hertz = hertz
            self.limit = RateLimit(hertz or 1)

    def end(self, now: int) -> None:
        self._release(now)
        self.has_ended = True

    def _release(self, now: int) -> None:
        held, self.held, self.next_due = self.held, None, None
        if held is not None and held.is_stale(now):
            self.fate(now, held, "stale")
        elif held is not None:
            self._pass_on(now, held)

    def _pass_on(self, now: int, message: Message) -> None:
        if self.pacer is None or self.has_ended:
            self.fate(now, message, "stale" if message.is_stale(now) else "sent")
        else:
            self.pacer.offer(now, message)

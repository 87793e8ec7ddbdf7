"""What one client gets, at its own pace: what it cannot take yet waits, of each topic the latest value at worst.

Knows neither sockets nor what the frames say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from router.edges.gateway_transport import HIGH_WATER, Client, Frame
from router.gateway.outbox import Outbox

MOST_WAITING = 1 << 20
"""Bytes that wait for a client in the order in which they came; beyond that, the latest value of each topic does."""

OnWire = Callable[[Sequence[Frame]], Sequence[Frame]]


class Subscriber:
    """`number` is the client's label in metrics: the lowest that no other client of the gateway has.

    `sent` and `dropped` are frames since it came. Times are monotonic, in ns.
    """

    def __init__(self, client: Client, number: int, on_wire: OnWire) -> None:
        self.client = client
        self.number = number
        self.sent = 0
        self.dropped = 0
        self._on_wire = on_wire
        self._outbox = Outbox(MOST_WAITING)

    @property
    def keeps_up(self) -> bool:
        """Whether it can be written to at once."""
        return not len(self._outbox) and self.client.backlog() < HIGH_WATER

    @property
    def waiting(self) -> int:
        """Frames that it has not been written yet."""
        return len(self._outbox)

    def lag(self, now: int) -> int:
        """How long the oldest frame has waited for it, in ns; 0 while none waits."""
        return self._outbox.lag(now)

    def send(self, frames: Sequence[Frame], now: int) -> int:
        """At once, or when it can take them. Returns how many others they took the place of."""
        if self.keeps_up:
            self.client.write(self._on_wire(frames))
            self.sent += len(frames)
            return 0
        superseded = sum(self._outbox.offer(frame, now) for frame in frames)
        self.dropped += superseded
        return superseded

    def drained(self) -> None:
        """It can take more."""
        while len(self._outbox) and self.client.backlog() < HIGH_WATER:
            frames = self._outbox.take(HIGH_WATER)
            self.client.write(self._on_wire(frames))
            self.sent += len(frames)

"""What one client gets, at its own pace: at once, or from the history when it can take more. Knows no sockets."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

from router.gateway.history import History
from router.gateway.transport.base import HIGH_WATER, Client, Frame

OnWire = Callable[[Sequence[Frame]], Sequence[Frame]]


class Subscriber:
    """`number` is the client's label in metrics: the lowest that no other client of the gateway has.

    `sent` and `dropped` are frames since it came; a frame is dropped when a newer one of its topic took its place.
    Times are monotonic, in ns.
    """

    def __init__(self, client: Client, number: int, history: History, on_wire: OnWire) -> None:
        self.client = client
        self.number = number
        self.sent = 0
        self.dropped = 0
        self._history = history
        self._on_wire = on_wire
        self._behind_since: int | None = None
        self._next = 0  # the first frame that it has not got
        self._from = 0  # where it fell behind
        self._taken = self._told = 0  # since then: frames that it got, and those that were told as dropped
        self._got: dict[Hashable, int] = {}  # latest frames, by key, since it is too far behind to get every one

    @property
    def is_behind(self) -> bool:
        return self._behind_since is not None

    @property
    def keeps_up(self) -> bool:
        """Whether it can be written to at once."""
        return self._behind_since is None and self.client.backlog() < HIGH_WATER

    def lag(self, now: int) -> int:
        """For how long it has not had everything, in ns; 0 for one that has."""
        return 0 if self._behind_since is None else now - self._behind_since

    @property
    def waiting(self) -> int:
        """Frames that it is still to get."""
        return self._history.waiting(self._next, self._got) if self.is_behind else 0

    def write(self, frames: Sequence[Frame]) -> None:
        """Only if it keeps up."""
        self.client.write(self._on_wire(frames))
        self.sent += len(frames)

    def fall_behind(self, now: int) -> None:
        """What is added to the history from now on it gets when it can take it."""
        self._behind_since = now
        self._next = self._from = self._history.end
        self._taken = self._told = 0

    def settle(self) -> int:
        """How many more frames were dropped since this was asked last."""
        if self._behind_since is None:
            return 0
        gone = self._history.end - self._from - self._taken - self.waiting
        new, self._told = gone - self._told, gone
        self.dropped += new
        return new

    def drained(self) -> int:
        """Writes as much as it can take. Returns how many more frames were dropped."""
        while self._behind_since is not None and self.client.backlog() < HIGH_WATER:
            frames = self._following()
            if frames:
                self._taken += len(frames)
                self.write(frames)
            else:
                dropped = self.settle()
                self._behind_since = None
                self._got.clear()
                return dropped
        return self.settle()

    def _following(self) -> list[Frame]:
        if not self._got and self._next >= self._history.begin:
            frames = self._history.following(self._next, HIGH_WATER)
            self._next += len(frames)
            return frames
        frames, size = [], 0
        for each in self._history.newer(self._next, self._got):
            size += len(each.frame.data)
            if frames and size > HIGH_WATER:
                break
            self._got[each.key] = each.number
            frames.append(each.frame)
        return frames

"""`collect` by its rules in docs/reference/table.md, in lists that are searched from end to end.

One collector with its limits and timeout. It counts the outcome of each part except the first part of a completed
frame, whose outcome is the outcome of the frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import NamedTuple

COLLECTED, FILTERED, INCOMPLETE, MAPPING_ERROR = "collected", "filtered", "incomplete", "mapping_error"


class Part(NamedTuple):
    """A datagram: `key` is the sender with its name for the frame, `place` is the position in the frame."""

    key: Hashable
    size: int
    place: int
    payload: bytes


class Limits(NamedTuple):
    """`size` limits the bytes of all held payloads."""

    frames: int
    parts: int
    size: int
    closed: int


LIMITS = Limits(64, 8192, 1 << 24, 1024)


@dataclass
class _Frame:
    key: Hashable
    count: int
    ends_at: int
    parts: list[Part] = field(default_factory=list)


@dataclass
class Frames:
    timeout: int
    limits: Limits = LIMITS
    counted: Counter[str] = field(default_factory=Counter)
    details: list[str] = field(default_factory=list)
    """Texts of the losses, in order."""
    open: list[_Frame] = field(default_factory=list)
    """Open frames, oldest first."""
    closed: list[tuple[Hashable, int]] = field(default_factory=list)
    """Ended frames with the time until which they are remembered, earliest first."""

    @property
    def next_due(self) -> int | None:
        return min((frame.ends_at for frame in self.open), default=None)

    def tick(self, now: int) -> None:
        for frame in [frame for frame in self.open if frame.ends_at <= now]:
            self._end(frame, now)
        while self.closed and self.closed[0][1] <= now:
            self.closed.pop(0)

    def end(self, now: int) -> None:
        for frame in [*self.open]:
            self._end(frame, now)

    def offer(self, now: int, part: Part) -> list[bytes] | None:
        """Add a part. Return the payloads of the frame if it is now complete, else None."""
        if not 0 <= part.place < part.size:
            self._lose(MAPPING_ERROR, f"a frame of {part.size} has no part {part.place}")
            return None
        self.tick(now)
        if part.size > self.limits.parts:
            self._lose(INCOMPLETE, f"a frame of {part.size} parts, more than {self.limits.parts}")
            return None
        for frame in [frame for frame in self.open if frame.key == part.key and frame.count != part.size]:
            self._give_up(frame)
        found = [frame for frame in self.open if frame.key == part.key]
        is_there = any(part.place == held.place for frame in found for held in frame.parts)
        if is_there or any(key == part.key for key, _ in self.closed):
            self.counted[FILTERED] += 1
            return None
        if found:
            self.counted[COLLECTED] += 1
        else:
            if len(self.open) == self.limits.frames:
                self._end(self.open[0], now)
            self.open.append(_Frame(part.key, part.size, now + self.timeout))
            found = [self.open[-1]]
        [frame] = found
        frame.parts.append(part)
        if len(frame.parts) == frame.count:
            self.open.remove(frame)
            self._close(frame.key, now)
            return [held.payload for held in sorted(frame.parts, key=lambda held: held.place)]
        while self._held > self.limits.parts or self._size > self.limits.size:
            self._end(self.open[0], now)
        return None

    @property
    def _held(self) -> int:
        return sum(len(frame.parts) for frame in self.open)

    @property
    def _size(self) -> int:
        return sum(len(part.payload) for frame in self.open for part in frame.parts)

    def _end(self, frame: _Frame, now: int) -> None:
        self._give_up(frame)
        self._close(frame.key, now)

    def _give_up(self, frame: _Frame) -> None:
        self.open.remove(frame)
        self._lose(INCOMPLETE, f"{len(frame.parts)} of {frame.count} parts")

    def _close(self, key: Hashable, now: int) -> None:
        self.closed = [*self.closed, (key, now + self.timeout)][-self.limits.closed :]

    def _lose(self, reason: str, detail: str) -> None:
        self.counted[reason] += 1
        self.details.append(detail)

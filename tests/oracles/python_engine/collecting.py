"""`collect`: collects the parts of a frame, which arrive one by one in any order, into one list."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from router.errors import MappingError
from tests.oracles.python_engine.timers import Timer

MOST_FRAMES = 64
MOST_PARTS = 8192
MOST_CLOSED = 1024
"""Limits of what is held: open frames, parts of all of them, keys of closed frames."""


class PartOutcome(Protocol):
    """Counts what becomes of the parts at one target; `FrameOutcome` for the router's counters."""

    def collected(self) -> None: ...

    def filtered(self) -> None: ...

    def dropped(self, reason: str, *, detail: str) -> None: ...


@dataclass(slots=True)
class _Frame:
    count: int
    ends_at: int
    parts: dict[int, object] = field(default_factory=dict)


class Collector(Timer):
    """Collects the frames of one route. A frame ends `timeout` ns after its first part.

    `outcomes` are those of the targets that get the frames; each counts every part once. The first part stands for the
    whole frame: the caller counts the complete list, and an incomplete frame is dropped as `incomplete` here. The other
    parts are counted as collected. Copies are filtered, as are for another `timeout` parts of a frame that has ended:
    they are copies, or of a frame that was counted as lost.

    A frame also ends when there is no room, the oldest first, and when a part with the same key has another count,
    which opens a new frame. A part of a frame that is larger than MOST_PARTS is dropped as `incomplete`.
    """

    def __init__(self, timeout: int, outcomes: Sequence[PartOutcome]) -> None:
        self.next_due: int | None = None
        self._timeout = timeout
        self._outcomes = outcomes
        self._frames: OrderedDict[Hashable, _Frame] = OrderedDict()  # the oldest first
        self._closed: OrderedDict[Hashable, int] = OrderedDict()  # until when, the earliest first
        self._held = 0

    def offer(self, now: int, key: Hashable, count: int, index: int, part: object) -> list[object] | None:
        """Return the parts 0 to `count` - 1 if this one completes its frame, else None.

        Raises MappingError if `index` is out of range; the part is then not counted here.
        """
        if not 0 <= index < count:
            raise MappingError(f"a frame of {count} has no part {index}")
        self.due(now)
        if count > MOST_PARTS:
            self._drop(f"a frame of {count} parts, more than {MOST_PARTS}")
            return None
        frame = self._frames.get(key)
        if frame is not None and frame.count != count:
            self._give_up(key)
            frame = None
        if key in self._closed or (frame is not None and index in frame.parts):
            for outcome in self._outcomes:
                outcome.filtered()
            return None
        if frame is None:
            frame = self._open(now, key, count)
        else:
            for outcome in self._outcomes:
                outcome.collected()
        frame.parts[index] = part
        self._held += 1
        return self._completed(now, key, frame)

    def due(self, now: int) -> None:
        while self._frames and self._oldest.ends_at <= now:
            self._close_oldest(now)
        while self._closed and next(iter(self._closed.values())) <= now:
            self._closed.popitem(last=False)
        self._set_due()

    def end(self, now: int) -> None:
        while self._frames:
            self._close_oldest(now)
        self._set_due()

    def _open(self, now: int, key: Hashable, count: int) -> _Frame:
        if len(self._frames) == MOST_FRAMES:
            self._close_oldest(now)
        frame = self._frames[key] = _Frame(count, now + self._timeout)
        return frame

    def _completed(self, now: int, key: Hashable, frame: _Frame) -> list[object] | None:
        """Remove and return the frame if it is complete; make room if it is not."""
        complete = None
        if len(frame.parts) == frame.count:
            complete = [frame.parts[index] for index in range(frame.count)]
            self._remove(key)
            self._close(now, key)
        elif self._held > MOST_PARTS:
            self._close_oldest(now)
        self._set_due()
        return complete

    @property
    def _oldest(self) -> _Frame:
        return next(iter(self._frames.values()))

    def _set_due(self) -> None:
        self.next_due = self._oldest.ends_at if self._frames else None

    def _close_oldest(self, now: int) -> None:
        key = next(iter(self._frames))
        self._give_up(key)
        self._close(now, key)

    def _give_up(self, key: Hashable) -> None:
        frame = self._remove(key)
        self._drop(f"{len(frame.parts)} of {frame.count} parts")

    def _remove(self, key: Hashable) -> _Frame:
        frame = self._frames.pop(key)
        self._held -= len(frame.parts)
        return frame

    def _close(self, now: int, key: Hashable) -> None:
        self._closed[key] = now + self._timeout
        if len(self._closed) > MOST_CLOSED:
            self._closed.popitem(last=False)

    def _drop(self, detail: str) -> None:
        for outcome in self._outcomes:
            outcome.dropped("incomplete", detail=detail)

"""The frames that a simulated basestation puts together of the objects that arrive one by one."""

from __future__ import annotations

from typing import Any

from router.engine.collecting import Collector, PartOutcome
from router.errors import MappingError
from router.types.model import MessageType

PART = ("frame_id", "total_count", "index")
"""The fields by which a payload says which frame it belongs to, of how many parts, and which of them it is."""

TIMEOUT = 1_000_000_000
"""Nanoseconds from the first part of a frame after which the others are given up."""


def is_part(kind: MessageType) -> bool:
    return all(kind.field(name) for name in PART)


class Frames(PartOutcome):
    """Counts the frames of one payload case. `astray` are parts whose numbers fit no frame."""

    def __init__(self) -> None:
        self.complete = 0
        self.incomplete = 0
        self.astray = 0
        self._collector = Collector(TIMEOUT, [self])

    def take(self, now: int, part: Any) -> None:
        """A payload that `is_part`; monotonic ns."""
        try:
            whole = self._collector.offer(now, part.frame_id, part.total_count, part.index, part)
        except MappingError:
            self.astray += 1
        else:
            self.complete += whole is not None

    def look(self, now: int) -> None:
        """Time has passed."""
        self._collector.due(now)

    # what becomes of the parts, as the collector says

    def collected(self) -> None:
        """A part is no frame yet."""

    def filtered(self) -> None:
        """Nor is a copy of one."""

    def dropped(self, reason: str, *, detail: str) -> None:
        self.incomplete += 1

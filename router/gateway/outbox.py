"""What waits for one client that is slower than its topics: everything for a while, then the latest of each topic.

Pure: knows no socket, clock or format.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable
from itertools import islice
from typing import NamedTuple

from router.edges.gateway_transport import Frame

MOST_FRAMES = 1000
"""Frames that wait in their order. Each takes some 200 bytes beside its data, for each of maybe a thousand clients."""


class _Waiting(NamedTuple):
    """`since` is when the first one was offered that had this place."""

    frame: Frame
    since: int


class Outbox:
    """Frames in the order in which they were offered, as long as they have no more than `most_bytes` and are not many.

    Beyond that a frame takes the place of those of its topic that wait, so that a topic keeps its turn and costs
    one frame; a topic of which nothing waits still gets one in. A schema is never displaced by data, stays before
    the data of its type, and waits once.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._waiting: dict[int, _Waiting] = {}  # by a number that only grows: the order
        self._places: defaultdict[Hashable, list[int]] = defaultdict(list)  # where each topic's and type's frames wait
        self._next = 0
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def offer(self, frame: Frame, now: int) -> int:
        """Lets it wait, and returns how many frames that displaced. `now` is in ns of the monotonic clock."""
        key = _key(frame)
        places = self._places[key]
        if frame.is_schema and places:  # it says the same as the one that waits
            self._put(places[0], frame)
            return 0
        if frame.is_schema or not places or self._has_room(frame):
            self._append(key, frame, now)
            return 0
        displaced = len(places)
        first, *others = places
        for place in others:
            self._remove(place)
        if self._schema_place(frame.type_name) > first:
            self._remove(first)
            self._append(key, frame, now)
        else:
            self._put(first, frame)
        return displaced

    def take(self, most_bytes: int) -> list[Frame]:
        """The next frames, no more than `most_bytes` of them but at least one if any waits."""
        taken: list[Frame] = []
        size = 0
        for waiting in self._waiting.values():
            size += len(waiting.frame.data)
            if taken and size > most_bytes:
                break
            taken.append(waiting.frame)
        for place in list(islice(self._waiting, len(taken))):
            self._remove(place)
        return taken

    def lag(self, now: int) -> int:
        """How long the next frame, or those whose place it took, have been waiting, in ns; 0 when none is."""
        for waiting in self._waiting.values():
            return now - waiting.since
        return 0

    def _has_room(self, frame: Frame) -> bool:
        return self.bytes + len(frame.data) <= self._most_bytes and len(self._waiting) < MOST_FRAMES

    def _append(self, key: Hashable, frame: Frame, now: int) -> None:
        self._places[key].append(self._next)
        self._waiting[self._next] = _Waiting(frame, now)
        self.bytes += len(frame.data)
        self._next += 1

    def _put(self, place: int, frame: Frame) -> None:
        """In place of the one that waits there."""
        before = self._waiting[place]
        self._waiting[place] = _Waiting(frame, before.since)
        self.bytes += len(frame.data) - len(before.frame.data)

    def _remove(self, place: int) -> None:
        frame = self._waiting.pop(place).frame
        self.bytes -= len(frame.data)
        key = _key(frame)
        self._places[key].remove(place)
        if not self._places[key]:
            del self._places[key]

    def _schema_place(self, type_name: str) -> int:
        """Where the schema of this type waits, -1 if it does not."""
        places = self._places.get((True, type_name))
        return places[0] if places else -1


def _key(frame: Frame) -> Hashable:
    return (True, frame.type_name) if frame.is_schema else (False, frame.topic)

"""What a gateway sent while some client was behind: every frame for a while, then the latest of each topic.

One for all clients of a gateway: a client that stands still costs a number, and no work. Pure: no socket, no clock.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Hashable, Iterable, Mapping
from itertools import islice
from typing import NamedTuple

from router.gateway.transport.base import Frame

MOST_BYTES = 1 << 20
MOST_FRAMES = 1000
"""What is kept in its order; the oldest goes first."""

Key = tuple[bool, str, str]


class Latest(NamedTuple):
    """The newest frame of its key, and its number."""

    number: int
    key: Hashable
    frame: Frame


class History:
    """Frames are numbered. Those from `begin` to before `end` are there in their order; of all since it was empty there
    is the latest for each topic, and each schema.
    """

    def __init__(self, most_bytes: int = MOST_BYTES, most_frames: int = MOST_FRAMES) -> None:
        self.end = 0
        self._most_bytes = most_bytes
        self._most_frames = most_frames
        self._recent: deque[Frame] = deque()
        self._bytes = 0
        self._latest: dict[Hashable, Latest] = {}  # in the order of their numbers
        self._numbers: list[int] = []
        self._counted_at = 0

    @property
    def begin(self) -> int:
        return self.end - len(self._recent)

    def add(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            key = _key(frame)
            self._latest.pop(key, None)
            self._latest[key] = Latest(self.end, key, frame)
            self._recent.append(frame)
            self._bytes += len(frame.data)
            self.end += 1
        while len(self._recent) > self._most_frames or self._bytes > self._most_bytes:
            self._bytes -= len(self._recent.popleft().data)

    def clear(self) -> None:
        """Nobody is behind any more. Numbers go on."""
        self._recent.clear()
        self._bytes = 0
        self._latest.clear()

    def following(self, number: int, most_bytes: int) -> list[Frame]:
        """Frames from `number` on, which is not before `begin`: at most `most_bytes`, but for the first."""
        found: list[Frame] = []
        size = 0
        for frame in islice(self._recent, number - self.begin, None):
            size += len(frame.data)
            if found and size > most_bytes:
                break
            found.append(frame)
        return found

    def newer(self, number: int, got: Mapping[Hashable, int]) -> list[Latest]:
        """The latest frames from `number` on that are not among `got`, which has the numbers of those that are.

        Schemas first; then those whose topics had their turn longest ago.
        """
        found = [each for each in self._latest.values() if each.number >= number and each.number != got.get(each.key)]
        return sorted(found, key=lambda each: (not each.frame.is_schema, got.get(each.key, -1)))

    def waiting(self, number: int, got: Mapping[Hashable, int]) -> int:
        """How many frames who is at `number` is still to get."""
        if got:
            return len(self.newer(number, got))
        if number >= self.begin:
            return self.end - number
        if self._counted_at != self.end:
            self._counted_at, self._numbers = self.end, [each.number for each in self._latest.values()]
        return len(self._numbers) - bisect_left(self._numbers, number)


def _key(frame: Frame) -> Key:
    """A schema belongs to a type, and in packets to a topic as well; data to a topic."""
    return (True, frame.topic, frame.type_name) if frame.is_schema else (False, frame.topic, "")

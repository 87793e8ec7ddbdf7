"""The last datagrams, in memory, until somebody asks for them. Knows no file."""

from __future__ import annotations

import threading
from collections import deque

from router.recording.packed import Packed


class Ring:
    """What came within `last` ns, in batches of at most `most` bytes together: of a flood it keeps less than `last`.

    Any thread may use it.
    """

    def __init__(self, last: int, most: int) -> None:
        self._last = last
        self._most = most
        self._batches: deque[Packed] = deque()
        self._changing = threading.Lock()
        self._size = 0

    def add(self, batch: Packed) -> None:
        with self._changing:
            batches = self._batches
            batches.append(batch)
            self._size += batch.size
            oldest = batch.monotonic - self._last
            while batches[0].monotonic < oldest or (self._size > self._most and len(batches) > 1):
                self._size -= batches.popleft().size

    def batches(self) -> list[Packed]:
        """The oldest first."""
        with self._changing:
            return list(self._batches)

"""The last datagrams, in memory: chunks that are written only when somebody asks. Knows no file."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from router.edges.recorder_chunk import Chunk


class Ring:
    """What came within `last` ns, in chunks of at most `most` bytes together: of a flood it keeps less than `last`."""

    def __init__(self, last: int, most: int) -> None:
        self._last = last
        self._most = most
        self._chunks: deque[Chunk] = deque()
        self.size = 0

    def add(self, chunk: Chunk) -> None:
        self._chunks.append(chunk)
        self.size += len(chunk.record.data)
        while self._chunks[0].steady < chunk.steady - self._last or (self.size > self._most and len(self._chunks) > 1):
            self.size -= len(self._chunks.popleft().record.data)

    def __iter__(self) -> Iterator[Chunk]:
        return iter(self._chunks)

    def __len__(self) -> int:
        return len(self._chunks)

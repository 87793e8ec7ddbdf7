"""A chunk of a recording in the making: message records, compressed together, with an index for each channel.

Knows the MCAP format, and not what messages mean.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk as ChunkRecord

HEAD = struct.Struct("<BQHIQQ")
"""A message record up to its data: opcode, length of what follows, channel, sequence, log time, publish time."""
BEHIND_LENGTH = HEAD.size - 9
_INDEX_HEAD = struct.Struct("<BQHI")


@dataclass(frozen=True, slots=True)
class Chunk:
    """Messages as they go into a file. `indexes` has the message index records by channel.

    `messages` counts them by channel; `datagrams` and `size` (bytes) are those that were received. `steady` is when the
    last one came, by a clock that nobody sets (ns).
    """

    record: ChunkRecord
    indexes: Mapping[int, bytes]
    messages: Mapping[int, int]
    datagrams: int
    size: int
    steady: int

    @property
    def size_in_file(self) -> int:
        """Bytes, with all that a file has to say of it, now and at its end, about."""
        return len(self.record.data) + sum(map(len, self.indexes.values())) + 200 + 10 * len(self.indexes)


class ChunkBuilder:
    """`pieces` have `offset` bytes together. Who adds to them by himself notes time and offset in `index`."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.offset = 0
        self._indexes: dict[int, list[int]] = {}
        self._compressor = zstandard.ZstdCompressor(level=1)

    def index(self, channel: int) -> list[int]:
        """Of each of the channel's messages log time and offset, one behind the other. The list stays the channel's."""
        return self._indexes.setdefault(channel, [])

    def add(self, channel: int, data: bytes, sequence: int, log_time: int, publish_time: int) -> None:
        head = HEAD.pack(Opcode.MESSAGE, BEHIND_LENGTH + len(data), channel, sequence, log_time, publish_time)
        self.pieces += (head, data)
        self.index(channel).extend((log_time, self.offset))
        self.offset += len(head) + len(data)

    def take(self, datagrams: int, size: int, steady: int) -> Chunk | None:
        """What was added since the last time, None where that is nothing."""
        if not self.pieces:
            return None
        data = b"".join(self.pieces)
        filled = {channel: index for channel, index in self._indexes.items() if index}
        record = ChunkRecord(
            compression="zstd",
            data=self._compressor.compress(data),
            message_start_time=min(min(index[::2]) for index in filled.values()),
            message_end_time=max(max(index[::2]) for index in filled.values()),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        indexes = {channel: _index_record(channel, index) for channel, index in filled.items()}
        messages = {channel: len(index) // 2 for channel, index in filled.items()}
        for index in filled.values():
            index.clear()
        self.pieces.clear()
        self.offset = 0
        return Chunk(record, indexes, messages, datagrams, size, steady)


def _index_record(channel: int, index: Sequence[int]) -> bytes:
    size = 8 * len(index)
    return _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size) + struct.pack(f"<{len(index)}Q", *index)

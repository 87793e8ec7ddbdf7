"""One MCAP file: chunks go in, and what is in it can be read whenever writing ends, for whatever reason.

Knows the format of files and no datagram.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from router.recording.channels import Channels
from router.recording.chunk import Chunk

LIBRARY = "rover_router"
"""What the library is called that wrote a recording; its version follows."""
METADATA = "router"


class RecordingFile:
    """A file that was not there before. Everything raises OSError.

    `about` says what is recorded, and why; it is the file's metadata.
    """

    def __init__(self, path: Path, channels: Channels, about: Mapping[str, str]) -> None:
        self.path = path
        self.size = 0
        self._channels = channels
        self._written_channels: set[int] = set()
        self._written_schemas: set[int] = set()
        self._indexes: list[ChunkIndex] = []
        self._messages: Counter[int] = Counter()
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        head = MCAP0_MAGIC + _bytes_of(Header("", f"{LIBRARY} {version('rover-router')}"))
        metadata = _bytes_of(Metadata(name=METADATA, metadata=dict(about)))
        self._metadata = MetadataIndex(offset=len(head), length=len(metadata), name=METADATA)
        try:
            self._append(head + metadata)
        except OSError:
            os.close(self._descriptor)
            path.unlink()
            raise

    @property
    def is_removed(self) -> bool:
        """Whether somebody has removed it: what is written to it is in no directory any more."""
        return os.fstat(self._descriptor).st_nlink == 0

    @property
    def is_empty(self) -> bool:
        """Whether there is no chunk in it."""
        return not self._indexes

    def write(self, chunk: Chunk) -> None:
        """What could not be written whole is cut off again."""
        introduced = self._introduce(chunk)
        record = _bytes_of(chunk.record)
        start = self.size + len(introduced)
        offsets, position = {}, start + len(record)
        for channel, index in chunk.indexes.items():
            offsets[channel] = position
            position += len(index)
        self._append(b"".join((introduced, record, *chunk.indexes.values())))
        self._note(chunk, start, len(record), offsets)

    def sync(self) -> None:
        """Returns when what was written outlasts a loss of power."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Writes what readers seek by. A file without it can be read from the start."""
        try:
            self._append(self._end())
            self.sync()
        finally:
            os.close(self._descriptor)

    def _introduce(self, chunk: Chunk) -> bytes:
        """The channels that the chunk is the first to use, each behind its schema."""
        builder = RecordBuilder()
        for number in chunk.messages.keys() - self._written_channels:
            channel = self._channels.channels[number]
            if channel.schema_id not in self._written_schemas:
                self._channels.schemas[channel.schema_id].write(builder)
            channel.write(builder)
        return _taken(builder)

    def _note(self, chunk: Chunk, start: int, length: int, offsets: dict[int, int]) -> None:
        self._written_channels |= chunk.messages.keys()
        self._written_schemas |= {self._channels.channels[number].schema_id for number in chunk.messages}
        self._messages.update(chunk.messages)
        record = chunk.record
        self._indexes.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=record.compression,
                compressed_size=len(record.data),
                message_end_time=record.message_end_time,
                message_index_length=sum(map(len, chunk.indexes.values())),
                message_index_offsets=offsets,
                message_start_time=record.message_start_time,
                uncompressed_size=record.uncompressed_size,
            )
        )

    def _end(self) -> bytes:
        """Data end, summary and footer."""
        end = _bytes_of(DataEnd(0))
        start = self.size + len(end)
        summary, offsets = RecordBuilder(), []
        for opcode, records in self._summary().items():
            first = summary.count
            for record in records:
                record.write(summary)
            if records:
                offsets.append(SummaryOffset(opcode, start + first, summary.count - first))
        offsets_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        told = _taken(summary)
        footer = _bytes_of(Footer(start, offsets_start, 0))
        crc = zlib.crc32(told + footer[:-4])
        return end + told + footer[:-4] + crc.to_bytes(4, "little") + MCAP0_MAGIC

    def _summary(self) -> dict[Opcode, list[McapRecord]]:
        return {
            Opcode.SCHEMA: [self._channels.schemas[number] for number in sorted(self._written_schemas)],
            Opcode.CHANNEL: [self._channels.channels[number] for number in sorted(self._written_channels)],
            Opcode.STATISTICS: [
                Statistics(
                    attachment_count=0,
                    channel_count=len(self._written_channels),
                    channel_message_counts=dict(self._messages),
                    chunk_count=len(self._indexes),
                    message_count=self._messages.total(),
                    message_end_time=max((index.message_end_time for index in self._indexes), default=0),
                    message_start_time=min((index.message_start_time for index in self._indexes), default=0),
                    metadata_count=1,
                    schema_count=len(self._written_schemas),
                )
            ],
            Opcode.CHUNK_INDEX: list(self._indexes),
            Opcode.METADATA_INDEX: [self._metadata],
        }

    def _append(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self.size)
            os.lseek(self._descriptor, self.size, os.SEEK_SET)
            raise
        self.size += len(data)


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return _taken(builder)


def _taken(builder: RecordBuilder) -> bytes:
    taken: bytes = builder.end()  # type: ignore[no-untyped-call]  # of mcap
    return taken

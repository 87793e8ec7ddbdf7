"""Writes recordings: a single MCAP file of chunks, the directory of the files, and continuous recording.

However writing ends, the written part of a file is readable.
"""

from __future__ import annotations

import errno
import os
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import (
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from router import __version__
from router.clock import wall_ns
from router.errors import ConfigurationError
from router.log import logger
from router.recording.channels import Channels
from router.recording.encoder import Chunk
from router.shortage import is_shortage
from router.table.model import RecordSettings

LIBRARY = "rover_router"
"""The name of the library that wrote a recording; its version follows."""
METADATA = "router"
SUFFIX = ".mcap"

_TIME = "%Y%m%dT%H%M%S.%fZ"
_RETRY = 10_000_000_000
"""ns until the next attempt after a disk error."""


class RecordingFile:
    """A new recording file. All methods raise OSError. `about` is its metadata: what is recorded, and why."""

    def __init__(self, path: Path, channels: Channels, about: Mapping[str, str]) -> None:
        self.path = path
        self.size = 0
        self._channels = channels
        self._written_schemas: set[int] = set()
        self._indexes: list[ChunkIndex] = []
        self._messages: Counter[int] = Counter()
        head = MCAP0_MAGIC + _encoded([Header("", f"{LIBRARY} {__version__}")])
        metadata = _encoded([Metadata(name=METADATA, metadata=dict(about))])
        self._metadata = MetadataIndex(offset=len(head), length=len(metadata), name=METADATA)
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            self._append(head + metadata)
        except OSError:
            os.close(self._descriptor)
            path.unlink()
            raise

    @property
    def is_gone(self) -> bool:
        """Whether the file at its path is another one or missing: moved, removed or unmounted."""
        try:
            return not os.path.samestat(self.path.stat(), os.fstat(self._descriptor))
        except OSError:
            return True

    def write(self, chunk: Chunk) -> None:
        """Append a chunk. A partial write is truncated again."""
        new = sorted(chunk.messages.keys() - self._messages.keys())
        channels = [self._channels.channels[number] for number in new]
        schemas = sorted({channel.schema_id for channel in channels} - self._written_schemas)
        introduced = _encoded([*(self._channels.schemas[number] for number in schemas), *channels])
        record = _encoded([chunk.record])
        start = self.size + len(introduced)
        offsets, position = {}, start + len(record)
        for channel, index in chunk.indexes.items():
            offsets[channel] = position
            position += len(index)
        self._append(b"".join((introduced, record, *chunk.indexes.values())))
        self._written_schemas.update(schemas)
        self._messages.update(chunk.messages)
        self._indexes.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=start,
                compression=chunk.record.compression,
                compressed_size=len(chunk.record.data),
                message_end_time=chunk.record.message_end_time,
                message_index_length=sum(map(len, chunk.indexes.values())),
                message_index_offsets=offsets,
                message_start_time=chunk.record.message_start_time,
                uncompressed_size=chunk.record.uncompressed_size,
            )
        )

    def sync(self) -> None:
        """Return when the written data survives a power loss."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Write the index and close. A file without index is readable from the start."""
        try:
            self._append(self._end())
            self.sync()
        finally:
            self._close()

    def abandon(self) -> None:
        """Close a file after a write error; remove it if it has no chunk."""
        with suppress(OSError):
            if not self._indexes:
                self.path.unlink()
        with suppress(OSError):
            self.close()

    def discard(self) -> None:
        """Remove a file after an error."""
        with suppress(OSError):
            self.path.unlink()
        if self._descriptor >= 0:
            self._close()

    def _close(self) -> None:
        descriptor, self._descriptor = self._descriptor, -1
        os.close(descriptor)

    def _end(self) -> bytes:
        """Return data end, summary and footer."""
        end = _encoded([DataEnd(0)])
        summary = _encoded(self._summary())
        footer = _encoded([Footer(summary_start=self.size + len(end), summary_offset_start=0, summary_crc=0)])[:-4]
        crc = zlib.crc32(summary + footer)
        return b"".join((end, summary, footer, crc.to_bytes(4, "little"), MCAP0_MAGIC))

    def _summary(self) -> list[McapRecord]:
        indexes = self._indexes
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._messages),
            channel_message_counts=dict(self._messages),
            chunk_count=len(indexes),
            message_count=self._messages.total(),
            message_end_time=max((index.message_end_time for index in indexes), default=0),
            message_start_time=min((index.message_start_time for index in indexes), default=0),
            metadata_count=1,
            schema_count=len(self._written_schemas),
        )
        return [
            *(self._channels.schemas[number] for number in sorted(self._written_schemas)),
            *(self._channels.channels[number] for number in sorted(self._messages)),
            statistics,
            *indexes,
            self._metadata,
        ]

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


def _encoded(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]  # of mcap
    return encoded


_DISK_FAILURES = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})


def _cannot_record(settings: RecordSettings, why: str | None) -> ConfigurationError:
    there = settings.directory
    remedy = f"create it for this user (sudo install -d -o $USER {there}), or give `record` another 'directory'"
    return ConfigurationError(f"{settings.span}: cannot record to {there}: {why}", remedy)


class RecordingDirectory:
    """The files `STEM_NUMBER_TIME[_REASON].mcap` in a table's `record.directory`; others are not touched.

    Later files have higher numbers: their order does not depend on the clock, which may be set back. They have at most
    `retention` bytes in total. Creates the directory. Raises ConfigurationError, but not if the disk is full or fails:
    that prevents no start, as it ends no router.
    """

    def __init__(self, settings: RecordSettings, stem: str) -> None:
        there = settings.directory
        try:
            there.mkdir(parents=True, exist_ok=True)
            if not os.access(there, os.W_OK | os.X_OK):
                if os.statvfs(there).f_flag & os.ST_RDONLY:
                    raise OSError(errno.EROFS, os.strerror(errno.EROFS))
                raise _cannot_record(settings, "this user has no write permission there")
        except OSError as error:
            if is_shortage(error):
                raise
            if error.errno not in _DISK_FAILURES:
                raise _cannot_record(settings, error.strerror) from error
            logger.error("nothing can be recorded now; routing all the same", where=str(there), problem=error.strerror)
        self.path = settings.directory.resolve()
        self._stem = stem
        self._retention = settings.retention

    def new(self, reason: str, channels: Channels, about: Mapping[str, str], at: int) -> RecordingFile:
        """Create a file with the next number and the time `at` (wall clock, ns). Raises OSError."""
        number = 1 + max((number for number, _ in _numbered(self.path, self._stem)), default=0)
        time = datetime.fromtimestamp(at / 1e9, timezone.utc).strftime(_TIME)
        words = [self._stem, f"{number:06}", time]
        if reason:
            words.append(re.sub(r"[^a-z0-9_.-]+", "-", reason.lower()))
        return RecordingFile(self.path / f"{'_'.join(words)}{SUFFIX}", channels, about)

    def make_room(self, coming: int, writing: Path | None = None) -> None:
        """Remove the oldest files, by number, until there is room for `coming` bytes in addition to the file `writing`.

        Recreates the directory if it was removed. Raises OSError.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        sizes = {path: size for path, size in recording_sizes(self.path, self._stem).items() if path != writing}
        total = sum(sizes.values())
        for path, size in sizes.items():
            if total + coming <= self._retention:
                return
            path.unlink(missing_ok=True)
            total -= size
            logger.info("removed the oldest recording to stay within 'retention'", file=str(path), bytes=size)


def recording_sizes(path: Path, stem: str) -> dict[Path, int]:
    """Return the bytes of each recording of a table in `path`, oldest first."""
    sizes: dict[Path, int] = {}
    for _, file in sorted(_numbered(path, stem)):
        with suppress(FileNotFoundError):  # removed meanwhile
            sizes[file] = file.stat().st_size
    return sizes


def _numbered(path: Path, stem: str) -> Iterator[tuple[int, Path]]:
    """Yield each recording of a table in `path` with its number."""
    name = re.compile(
        re.escape(stem) + r"_(\d{6,})_\d{8}T\d{6}\.\d{6}Z(?:_[a-z0-9_.-]+)?" + re.escape(SUFFIX), re.ASCII
    )
    for file in path.iterdir() if path.is_dir() else ():
        if found := name.fullmatch(file.name):
            yield int(found[1]), file


class ContinuousWriter:
    """Writes all chunks to a series of files, and counts datagrams that the disk does not accept in `lost`.

    Starts a file if there is something to write and the last one is full or old enough; calls `about` for each. Times
    are on the boot clock, in ns.
    """

    def __init__(
        self,
        settings: RecordSettings,
        directory: RecordingDirectory,
        channels: Channels,
        about: Callable[[], Mapping[str, str]],
    ) -> None:
        self.datagrams = self.bytes = self.lost = 0
        self._max_size = min(settings.max_size, settings.retention)
        self._max_age = settings.max_age
        self._directory = directory
        self._channels = channels
        self._about = about
        self._file: RecordingFile | None = None
        self._opened = 0
        self._retry_at: int | None = None

    @property
    def path(self) -> Path | None:
        """The path of the file that is being written."""
        return self._file.path if self._file is not None else None

    def write(self, chunk: Chunk, now: int) -> None:
        """Write and sync. Disk errors are logged, not raised."""
        if self._retry_at is not None and now < self._retry_at:
            self.lost += chunk.datagrams
            return
        try:
            file = self._file_for(chunk, now)
            file.write(chunk)
            file.sync()
        except OSError as error:
            self._failed(error, chunk, now)
            return
        except Exception:
            self.lost += chunk.datagrams
            raise
        if self._retry_at is not None:
            self._retry_at = None
            logger.info("recording resumed", file=str(file.path), lost=self.lost)
        self.datagrams += chunk.datagrams
        self.bytes += chunk.size

    def close_if_old(self, now: int) -> None:
        if self._file is not None and now - self._opened >= self._max_age:
            self.close()

    def close(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.close()
        except OSError as error:
            event = "the recording could not be finished and has no index; it is readable without one"
            logger.error(event, file=str(file.path), problem=error.strerror)

    def _file_for(self, chunk: Chunk, now: int) -> RecordingFile:
        file = self._file
        if file is not None and file.is_gone:
            logger.warning("the recording was moved or removed; starting another", file=str(file.path))
            self.close()
        elif file is not None and file.size + chunk.size_in_file > self._max_size:
            self.close()
        if self._file is None:
            self._directory.make_room(self._max_size)
            self._file = self._directory.new("", self._channels, self._about(), wall_ns())
            self._opened = now
        return self._file

    def _failed(self, error: OSError, chunk: Chunk, now: int) -> None:
        self.lost += chunk.datagrams
        if self._retry_at is None:
            where = str(self._file.path if self._file is not None else self._directory.path)
            remedy = "free disk space, or give `record` a smaller `retention`"
            logger.error("cannot record; retrying every 10 s", where=where, problem=error.strerror, remedy=remedy)
        self._retry_at = now + _RETRY
        if self._file is not None:
            self._file.abandon()
            self._file = None

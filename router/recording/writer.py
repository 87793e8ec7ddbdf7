"""Writes recordings: a single MCAP file, the directory of the files, and continuous recording.

However writing ends, the written part of a file is readable.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import IO, cast

from mcap.writer import Writer

from router import __version__
from router.clock import wall_ns
from router.errors import ConfigurationError
from router.log import logger
from router.recording.channels import Channels
from router.recording.encoder import Batch, Encoder, Message
from router.shortage import is_shortage
from router.table.model.settings import RecordSettings

LIBRARY = "rover_router"
"""The name of the library that wrote a recording; its version follows."""
METADATA = "router"
SUFFIX = ".mcap"

LONGEST_CHUNK = 4 << 20
"""Uncompressed bytes."""

_TIME = "%Y%m%dT%H%M%S.%fZ"
_RETRY = 10_000_000_000
"""ns until the next attempt after a disk error."""


class MessageWriter:
    """Writes messages to `output` as MCAP, in compressed chunks. `about` is the metadata: what is recorded, and why."""

    def __init__(self, output: IO[bytes], channels: Channels, about: Mapping[str, str]) -> None:
        self._channels = channels
        self._schemas: dict[int, int] = {}
        self._numbers: dict[int, int] = {}  # of channels in this file
        self._writer = Writer(output, chunk_size=LONGEST_CHUNK)
        self._writer.start(library=f"{LIBRARY} {__version__}")
        self._writer.add_metadata(METADATA, dict(about))

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages. A channel is written with its first message."""
        numbers, add = self._numbers, self._writer.add_message
        for channel, log_time, data, publish_time, sequence in messages:
            add(numbers.get(channel) or self._number(channel), log_time, data, publish_time, sequence)

    def flush(self) -> None:
        """End the chunk, and flush `output`."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # of mcap

    def finish(self) -> None:
        """Write the remaining messages and the index, and flush `output`."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # of mcap
        self._writer.flush()  # type: ignore[no-untyped-call]  # of mcap

    def _number(self, number: int) -> int:
        channel = self._channels.channels[number]
        if channel.schema_id not in self._schemas:
            schema = self._channels.schemas[channel.schema_id]
            self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        self._numbers[number] = self._writer.register_channel(
            channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
        )
        return self._numbers[number]


class _Output:
    """A new file. Keeps in memory what is written until `flush`, which writes all of it or, if it raises, nothing.

    `write` and `tell` do not raise OSError.
    """

    def __init__(self, path: Path) -> None:
        self.size = 0
        """Bytes in the file."""
        self.descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._waiting = bytearray()

    def write(self, data: bytes) -> None:
        self._waiting += data

    def tell(self) -> int:
        return self.size + len(self._waiting)

    def flush(self) -> None:
        waiting, self._waiting = self._waiting, bytearray()
        try:
            rest = memoryview(waiting)
            while rest:
                rest = rest[os.write(self.descriptor, rest) :]
        except OSError:
            os.ftruncate(self.descriptor, self.size)
            raise
        self.size += len(waiting)

    def sync(self) -> None:
        """Return when the file survives a power loss."""
        os.fdatasync(self.descriptor)

    def close(self) -> None:
        os.close(self.descriptor)


class RecordingFile:
    """A new recording file. All methods raise OSError."""

    def __init__(self, path: Path, channels: Channels, about: Mapping[str, str]) -> None:
        self.path = path
        self._output = _Output(path)
        self._messages = MessageWriter(cast("IO[bytes]", self._output), channels, about)
        self._is_open = self._is_empty = True
        with self._closed_on_error():
            self._output.flush()

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._output.size

    @property
    def is_gone(self) -> bool:
        """Whether the file at its path is another one or missing: moved, removed or unmounted."""
        try:
            return not os.path.samestat(self.path.stat(), os.fstat(self._output.descriptor))
        except OSError:
            return True

    def write(self, messages: Iterable[Message]) -> None:
        """Append messages as a chunk, and return when it survives a power loss.

        If that fails, close the file as it was before, without an index, and remove it if it was empty.
        """
        with self._closed_on_error():
            self._messages.add(messages)
            self._messages.flush()
            self._output.sync()
        self._is_empty = False

    def close(self) -> None:
        """Write the index and close, if `write` has not. A file without an index is readable from the start."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._messages.finish()
            self._output.sync()
        finally:
            self._output.close()

    @contextmanager
    def _closed_on_error(self) -> Iterator[None]:
        try:
            yield
        except Exception:
            self._is_open = False
            with suppress(OSError):
                self._output.close()
                if self._is_empty:
                    self.path.unlink()
            raise


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

    def new(self, channels: Channels, about: Mapping[str, str], at: int) -> RecordingFile:
        """Create a file with the next number and the time `at` (wall clock, ns). Raises OSError."""
        return RecordingFile(self._next("", at), channels, about)

    def save(self, data: bytes, reason: str, at: int, reserve: int, writing: Path | None) -> Path:
        """Write a whole file, or nothing. Return its path. Raises OSError.

        Leaves room for `reserve` more bytes of the file `writing`.
        """
        self.make_room(len(data) + reserve, writing)
        if shutil.disk_usage(self.path).free < len(data):  # others need the rest
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        path = self._next(reason, at)
        output = _Output(path)
        try:
            output.write(data)
            output.flush()
            output.sync()
        except OSError:
            with suppress(OSError):
                path.unlink()
            raise
        finally:
            output.close()
        return path

    def _next(self, reason: str, at: int) -> Path:
        number = 1 + max((number for number, _ in _numbered(self.path, self._stem)), default=0)
        time = datetime.fromtimestamp(at / 1e9, timezone.utc).strftime(_TIME)
        words = [self._stem, f"{number:06}", time]
        if reason:
            words.append(re.sub(r"[^a-z0-9_.-]+", "-", reason.lower()))
        return self.path / f"{'_'.join(words)}{SUFFIX}"

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
        if match := name.fullmatch(file.name):
            yield int(match[1]), file


class ContinuousWriter:
    """Writes all batches to a series of files, and counts datagrams that the disk does not accept in `lost`.

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
        self._encoder = Encoder(channels)
        self._about = about
        self._file: RecordingFile | None = None
        self._opened = 0
        self._retry_at: int | None = None

    @property
    def path(self) -> Path | None:
        """The path of the file that is being written."""
        return self._file.path if self._file is not None else None

    def write(self, batches: Sequence[Batch], now: int) -> None:
        """Write batches as one chunk. Disk errors are logged, not raised."""
        if self._retry_at is not None and now < self._retry_at:
            self.lost += sum(batch.count() for batch in batches)
            return
        datagrams, received = self._encoder.datagrams, self._encoder.bytes
        try:
            file = self._file_for(sum(batch.size for batch in batches), now)
            file.write(message for batch in batches for message in self._encoder.messages(batch))
        except Exception as error:
            self.lost += sum(batch.count() for batch in batches)
            where, self._file = self.path or self._directory.path, None
            if not isinstance(error, OSError):
                raise
            self._failed(error, where, now)
            return
        if self._retry_at is not None:
            self._retry_at = None
            logger.info("recording resumed", file=str(file.path), lost=self.lost)
        self.datagrams += self._encoder.datagrams - datagrams
        self.bytes += self._encoder.bytes - received

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

    def _file_for(self, size: int, now: int) -> RecordingFile:
        file = self._file
        if file is not None and file.is_gone:
            logger.warning("the recording was moved or removed; starting another", file=str(file.path))
            self.close()
        elif file is not None and file.size + size > self._max_size:
            self.close()
        if self._file is None:
            self._directory.make_room(self._max_size)
            self._file = self._directory.new(self._channels, self._about(), wall_ns())
            self._opened = now
        return self._file

    def _failed(self, error: OSError, where: Path, now: int) -> None:
        if self._retry_at is None:
            remedy = "free disk space, or give `record` a smaller `retention`"
            logger.error("cannot record; retrying every 10 s", where=str(where), problem=error.strerror, remedy=remedy)
        self._retry_at = now + _RETRY

"""Everything to disk, one file after the other. Where the disk does not take it, datagrams are lost and counted.

Knows chunks and files; what is in them, and when they come, is the recorder's business.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from router.clock import wall_ns
from router.log import logger
from router.recording.channels import Channels
from router.recording.chunk import Chunk
from router.recording.directory import RecordingDirectory
from router.recording.file import RecordingFile
from router.table.model import RecordSettings

_RETRY = 10_000_000_000
"""ns until a disk that failed is tried again."""


class Continuous:
    """Begins a file when there is something to write and the last one is full or old enough.

    `about` is asked for each file. Times are monotonic, in ns.
    """

    def __init__(
        self,
        settings: RecordSettings,
        directory: RecordingDirectory,
        channels: Channels,
        about: Callable[[], Mapping[str, str]],
    ) -> None:
        self.datagrams = self.bytes = self.lost = 0
        self._max_size = min(settings.max_size, settings.keep)
        self._max_age = settings.max_age
        self._directory = directory
        self._channels = channels
        self._about = about
        self._file: RecordingFile | None = None
        self._opened = 0
        self._retry_at: int | None = None

    @property
    def path(self) -> Path | None:
        """Of the file that is being written."""
        return self._file.path if self._file is not None else None

    def write(self, chunk: Chunk, now: int) -> None:
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
        except Exception:  # a fault of the router, for the caller to tell
            self.lost += chunk.datagrams
            raise
        if self._retry_at is not None:
            self._retry_at = None
            logger.info("recording again", file=str(file.path), lost=self.lost)
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
            told = "a recording could not be finished; it can be read all the same"
            logger.error(told, file=str(file.path), problem=error.strerror)

    def _file_for(self, chunk: Chunk, now: int) -> RecordingFile:
        if self._file is not None and self._file.size + chunk.size_in_file > self._max_size:
            self.close()
        if self._file is not None and self._file.is_removed:
            logger.warning("somebody removed the recording that was being written", file=str(self._file.path))
            self.close()
        if self._file is None:
            self._directory.make_room(self._max_size)
            self._file = self._directory.new(wall_ns(), "", self._channels, self._about())
            self._opened = now
        return self._file

    def _failed(self, error: OSError, chunk: Chunk, now: int) -> None:
        self.lost += chunk.datagrams
        if self._retry_at is None:
            where = str(self._file.path if self._file is not None else self._directory.path)
            remedy = "make room, or give `record` a smaller `keep`"
            logger.error("cannot record; trying again every 10 s", where=where, problem=error.strerror, remedy=remedy)
        self._retry_at = now + _RETRY
        self.close()

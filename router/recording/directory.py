"""The directory of recordings: names for new ones, and what has to go when they become too many.

Knows names and sizes, and nothing of what is in a file.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path

from router.errors import StartError
from router.log import logger
from router.recording.channels import Channels
from router.recording.file import RecordingFile
from router.table.model import RecordSettings

SUFFIX = ".mcap"
_TIME = "%Y%m%dT%H%M%S.%fZ"


class RecordingDirectory:
    """The files `STEM_TIME[_REASON].mcap` below `path` are ours; others are left alone.

    They have at most `keep` bytes. Makes the directory; raises OSError.
    """

    def __init__(self, path: Path, stem: str, keep: int) -> None:
        path.mkdir(parents=True, exist_ok=True)
        self.path = path.resolve()
        self._stem = stem
        self._keep = keep
        self._ours = _names(stem)

    def new(self, wall: int, reason: str, channels: Channels, about: Mapping[str, str]) -> RecordingFile:
        """A file that is not there yet; two at one time, as where the clock begins anew at each start, get numbers."""
        time = datetime.fromtimestamp(wall / 1e9, timezone.utc).strftime(_TIME)
        words = [self._stem, time, *([re.sub(r"[^a-z0-9_.-]+", "-", reason.lower())] if reason else [])]
        for number in range(1, 1000):
            name = "_".join([*words, *([str(number)] if number > 1 else [])]) + SUFFIX
            try:
                return RecordingFile(self.path / name, channels, about)
            except FileExistsError:
                continue
        raise FileExistsError(errno.EEXIST, f"there are a thousand recordings of {time}", str(self.path))

    def make_room(self, coming: int, writing: Path | None = None) -> None:
        """Removes the oldest, by name, until there is room for `coming` bytes. The one at `writing` is not counted.

        Somebody may have removed the directory; then it is made again.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        ours = sorted(path for path in self.path.iterdir() if path != writing and self._ours.fullmatch(path.name))
        sizes = {path: size for path in ours if (size := _size(path)) is not None}
        total = sum(sizes.values())
        for path, size in sizes.items():
            if total + coming <= self._keep:
                return
            path.unlink(missing_ok=True)
            total -= size
            logger.info("removed the oldest recording, to keep within 'keep'", file=str(path), bytes=size)


def kept_bytes(path: Path, stem: str) -> int:
    """Of our recordings below `path`, which is a directory or not there."""
    ours = _names(stem)
    there = path.iterdir() if path.is_dir() else ()
    return sum(_size(file) or 0 for file in there if ours.fullmatch(file.name))


def _names(stem: str) -> re.Pattern[str]:
    return re.compile(re.escape(stem) + r"_\d{8}T\d{6}\.\d{6}Z(_[a-z0-9_.-]+)?" + re.escape(SUFFIX))


def _size(path: Path) -> int | None:
    """None for what somebody has removed meanwhile."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return None


def open_directory(settings: RecordSettings, stem: str) -> RecordingDirectory:
    """Where a table has recordings written. Raises StartError."""
    try:
        directory = RecordingDirectory(settings.directory, stem, settings.keep)
    except OSError as error:
        raise StartError(f"{settings.span}: cannot record to {settings.directory}: {error.strerror}") from error
    if not os.access(settings.directory, os.W_OK | os.X_OK):
        raise StartError(f"{settings.span}: may not write to {settings.directory}; give `record` another directory")
    return directory

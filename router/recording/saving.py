"""Writes what is in memory to a file of its own: because somebody asked, or because a deadman tripped.

Knows no thread. What is called with `now` is monotonic, in ns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic, sleep

from router.clock import wall_ns
from router.errors import RouterError
from router.log import logger
from router.recording.channels import Channels
from router.recording.chunk import Chunk
from router.recording.directory import RecordingDirectory
from router.recording.encoding import Encoder
from router.recording.packed import Packed
from router.recording.ring import Ring

LONGEST_CHUNK = 4 << 20

_REST = 1.0
"""Beside each piece of work, in its time: so long others have the interpreter to themselves."""


class RecordError(RouterError):
    """The last datagrams could not be saved; the message says why."""


class Saving:
    """What came within `last` ns. `about` is asked for each file, with the reason."""

    def __init__(
        self,
        last: int,
        max_size: int,
        directory: RecordingDirectory,
        channels: Channels,
        about: Callable[[str], Mapping[str, str]],
    ) -> None:
        self._last = last
        self._max_size = max_size
        self._ring = Ring(last, max_size)
        self._directory = directory
        self._channels = channels
        self._about = about
        self._trips_saved_at: int | None = None

    def add(self, batch: Packed) -> None:
        """Any thread may."""
        self._ring.add(batch)

    def save(self, reason: str, writing: Callable[[], Path | None], meanwhile: Callable[[], None] | None) -> Path:
        """`writing` tells the file that all goes to, where there is one. Raises RecordError.

        It takes its time, and calls `meanwhile` between two pieces of work; None is without rests, because nobody
        routes any more.
        """
        try:
            path = self._write(reason, writing, meanwhile)
        except OSError as error:
            logger.error("the last datagrams could not be saved", reason=reason, problem=error.strerror)
            raise RecordError(f"cannot write to {self._directory.path}: {error.strerror}") from error
        logger.info("saved the last datagrams", reason=reason, file=str(path))
        return path

    def may_save_trips(self, now: int) -> bool:
        """Once in the time that is kept: a deadman that trips again and again fills no disk, and nothing is missed."""
        if self._trips_saved_at is not None and now - self._trips_saved_at < self._last:
            return False
        self._trips_saved_at = now
        return True

    def _write(self, reason: str, writing: Callable[[], Path | None], meanwhile: Callable[[], None] | None) -> Path:
        chunks = _chunks(self._ring.batches(), self._channels, meanwhile)
        coming = sum(chunk.size_in_file for chunk in chunks)
        also = writing()
        self._directory.make_room(coming + (self._max_size if also is not None else 0), also)
        file = self._directory.new(wall_ns(), reason, self._channels, self._about(reason))
        try:
            for chunk in chunks:
                file.write(chunk)
                if meanwhile is not None:
                    meanwhile()
        except OSError:
            if file.is_empty:
                file.path.unlink(missing_ok=True)
            raise
        finally:
            file.close()
        return file.path


def _chunks(batches: Sequence[Packed], channels: Channels, meanwhile: Callable[[], None] | None) -> list[Chunk]:
    """With `meanwhile` it takes its time: what is received goes first."""
    encoder, known = Encoder(channels, batches[0].before if batches else 0), None
    chunks: list[Chunk] = []
    for batch in batches:
        since = monotonic()
        if batch.known is not known:
            known = batch.known
            encoder.know(known)
        encoder.add(batch.unpacked(), batch.wall, batch.monotonic)
        if encoder.offset > LONGEST_CHUNK or batch is batches[-1]:
            chunk = encoder.take()
            chunks += [chunk] if chunk is not None else []
        if meanwhile is not None:
            sleep(_REST * (monotonic() - since))
            meanwhile()
    return chunks

"""A recording that another process than the router makes, of what its tap shows. Knows no HTTP."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from time import monotonic_ns, time_ns

from router.errors import UsageError
from router.observe.tap import Lost
from router.recording.channels import Channels
from router.recording.encoder import Encoder
from router.recording.mirror import Classifier, MirroredDatagram
from router.recording.recorder import PERIOD
from router.recording.writer import RecordingFile
from router.table.model import RouteTable
from router.types.protobuf import Envelope


class TapRecording:
    """One file, complete once it is closed. `datagrams` and `missed` count; raises UsageError where it cannot write."""

    def __init__(self, path: Path, envelope: Envelope, table: RouteTable) -> None:
        self.path = path
        self.datagrams = self.missed = 0
        channels = Channels()
        self._encoder = Encoder(channels)
        self._classifier = Classifier(envelope, table)
        self._written_at = monotonic_ns()
        try:
            self._file = RecordingFile(path, channels, {"reason": "router record", "table": table.path.name})
        except FileExistsError:
            raise UsageError(f"{path} exists; choose another name") from None
        except OSError as error:
            raise UsageError(f"cannot write {path}: {error.strerror}") from error

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return self._file.size

    def take(self, batch: Iterable[MirroredDatagram | Lost]) -> None:
        """Batches have to come once a second, be they empty, so that what came before is written."""
        seen: list[MirroredDatagram] = []
        for each in batch:
            if isinstance(each, Lost):
                self.missed += each.number
            else:
                seen.append(each)
        self._add(seen)
        if monotonic_ns() - self._written_at >= PERIOD:
            self._write()

    def close(self) -> None:
        """Writes what is left, and what readers seek by."""
        self._write()
        try:
            self._file.close()
        except OSError as error:
            raise UsageError(f"{self.path} could not be finished: {error.strerror}") from error

    def _add(self, seen: Sequence[MirroredDatagram]) -> None:
        self.datagrams += len(seen)
        self._encoder.add(seen, self._classifier, time_ns(), monotonic_ns())

    def _write(self) -> None:
        self._written_at = monotonic_ns()
        chunk = self._encoder.take()
        if chunk is None:
            return
        try:
            self._file.write(chunk)
            self._file.sync()
        except OSError as error:
            raise UsageError(f"cannot go on writing {self.path}: {error.strerror}") from error

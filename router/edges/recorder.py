"""The recorder: what listeners receive, before routing, to files and to memory. Its thread is `recorder`.

Knows when something is to be written; how, is known by the modules that it puts together.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotInTime
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from router.edges.alarm import Alarm
from router.edges.clock import monotonic_ns, wall_ns
from router.edges.log import logger
from router.edges.metrics import Asked
from router.edges.mirror import Shown
from router.edges.recorder_channels import Channels
from router.edges.recorder_continuous import Continuous
from router.edges.recorder_directory import open_directory
from router.edges.recorder_encoding import Encoder, Known
from router.edges.recorder_packed import Packer
from router.edges.recorder_saving import LONGEST_CHUNK, RecordError, Saving
from router.edges.running import Running
from router.table.model import RecordSettings

__all__ = ["RecordError", "Recorder"]

PERIOD = 500_000_000
"""ns from chunk to chunk: what a kill costs at most, with what the mirror still has."""

MOST_WAITING = 64 << 20
"""Bytes that may wait for a disk that is slow."""

_BESIDE_DATA = 256
"""About what Python needs for a datagram beside its data, in bytes."""
_PATIENCE = 30.0
"""Seconds in which saving has to be done."""


class _Batch(NamedTuple):
    datagrams: Sequence[Shown]
    known: Known
    wall: int
    monotonic: int
    size: int


class Recorder:
    """Records from its making until it is closed. Raises StartError where nothing can be written."""

    def __init__(self, running: Running, settings: RecordSettings) -> None:
        self._running = running
        self._channels = Channels()
        self._encoder = Encoder(self._channels)
        self._program = running.program
        self._known = self._encoded = Known.of(self._program.envelope, self._program.table.endpoints)
        self._encoder.know(self._known)
        directory = open_directory(settings, running.program.table.path.stem)
        self._continuous = Continuous(settings, directory, self._channels, self._about) if settings.continuous else None
        self._saving = (
            Saving(settings.last, settings.max_size, directory, self._channels, self._about)
            if settings.last is not None
            else None
        )
        self._packer = Packer()
        self._waiting: deque[_Batch] = deque()
        self._taken_in = self._taken_out = 0  # bytes, each written by one thread
        self._overflow = 0
        self._trips: deque[str] = deque()
        self._saves: deque[tuple[str, Future[Path]]] = deque()
        self._alarm = Alarm()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()
        self._detach = running.mirror.attach(self._take)

    def save(self, reason: str) -> Path:
        """Has what is in memory written to a file of its own. Any thread may ask; raises RecordError."""
        if self._saving is None:
            raise RecordError("nothing is kept in memory: the table's `record` has no `last`")
        if self._closing:
            raise RecordError("the router is stopping")
        done: Future[Path] = Future()
        self._saves.append((reason, done))
        self._wake()
        try:
            return done.result(_PATIENCE)
        except NotInTime:
            raise RecordError(f"the disk took longer than {_PATIENCE:.0f} s") from None

    def deadman_tripped(self, route: str) -> None:
        """Has it saved soon; returns at once."""
        if self._saving is not None:
            self._trips.append(route)
            self._wake()

    def asked(self) -> Mapping[str, Asked]:
        """The metrics that are counted here."""
        continuous = self._continuous

        def dropped() -> list[tuple[tuple[str], float]]:
            return [(("overflow",), self._overflow), (("write_error",), continuous.lost if continuous else 0)]

        return {
            "recorded_datagrams": lambda: [((), continuous.datagrams if continuous else 0)],
            "recorded_bytes": lambda: [((), continuous.bytes if continuous else 0)],
            "record_dropped": dropped,
        }

    def close(self) -> None:
        """Writes all that was received, and finishes the file."""
        self._detach()
        self._closing = True
        self._wake()
        self._thread.join()
        self._alarm.close()

    def _wake(self) -> None:
        with suppress(ValueError):  # it has ended
            self._alarm.ring()

    def _take(self, batch: Sequence[Shown]) -> None:
        """Called by the mirror's thread."""
        known, wall, monotonic = self._known_now(), wall_ns(), monotonic_ns()
        if self._saving is not None:
            self._saving.add(self._packer.pack(batch, known, wall, monotonic))
        if self._continuous is None:
            return
        size = sum([len(data) for _, _, _, data in batch]) + _BESIDE_DATA * len(batch)
        if self._taken_in - self._taken_out + size > MOST_WAITING:
            self._overflow += len(batch)
            return
        self._taken_in += size
        self._waiting.append(_Batch(batch, known, wall, monotonic, size))

    def _known_now(self) -> Known:
        """A reload may have changed it."""
        program = self._running.program
        if program is not self._program:
            self._program, self._known = program, Known.of(program.envelope, program.table.endpoints)
        return self._known

    def _run(self) -> None:
        flush_at = monotonic_ns() + PERIOD
        while not self._closing:
            self._alarm.wait(flush_at - monotonic_ns())
            try:
                self._turn(monotonic_ns())
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, is no reason to stop recording
                self._failed(error)
            flush_at = monotonic_ns() + PERIOD
        self._end()

    def _end(self) -> None:
        try:
            self._turn(monotonic_ns(), is_last=True)
        except Exception as error:  # noqa: BLE001 as above; what was written stays
            self._failed(error)
        if self._continuous is not None:
            self._continuous.close()
        for _, done in self._saves:
            done.set_exception(RecordError("the router is stopping"))

    def _failed(self, error: Exception) -> None:
        logger.critical("a fault in the recorder lost datagrams; please report it", exc_info=error)

    def _turn(self, now: int, is_last: bool = False) -> None:
        if self._continuous is not None:
            self._write(self._continuous, now)
            self._continuous.close_if_old(now)
        if self._saving is None:
            return
        while self._saves:
            reason, done = self._saves.popleft()
            try:
                done.set_result(self._saving.save(reason, self._writing()))
            except RecordError as error:
                done.set_exception(error)
        if self._trips and (is_last or self._saving.may_save_trips(now)):
            routes = sorted({self._trips.popleft() for _ in range(len(self._trips))})
            with suppress(RecordError):  # it has been logged
                self._saving.save(f"deadman-{routes[0]}", self._writing())

    def _writing(self) -> Path | None:
        return self._continuous.path if self._continuous is not None else None

    def _write(self, continuous: Continuous, now: int) -> None:
        for _ in range(len(self._waiting)):
            batch = self._waiting.popleft()
            if batch.known is not self._encoded:
                self._encoded = batch.known
                self._encoder.know(batch.known)
            self._encoder.add(batch.datagrams, batch.wall, batch.monotonic)
            self._taken_out += batch.size
            if self._encoder.offset > LONGEST_CHUNK and (chunk := self._encoder.take()) is not None:
                continuous.write(chunk, now)
        if (chunk := self._encoder.take()) is not None:
            continuous.write(chunk, now)

    def _about(self, reason: str = "continuous") -> dict[str, str]:
        """What a file says of itself."""
        program = self._running.program
        return {"reason": reason, "table": program.table.path.name, "protos_sha256": program.protos_sha256}

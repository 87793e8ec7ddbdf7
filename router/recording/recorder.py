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

from router.clock import monotonic_ns, wall_ns
from router.log import logger
from router.observe.metrics import Asked
from router.observe.running import Running
from router.recording.channels import Channels
from router.recording.continuous import Continuous
from router.recording.directory import open_directory
from router.recording.encoding import Encoder
from router.recording.mirror import Classifier, Mirrored
from router.recording.packed import Packer
from router.recording.queue import PERIOD, Intake
from router.recording.saving import RecordError, Saving
from router.table.model import RecordSettings
from router.threads import WakeEvent

__all__ = ["RecordError", "Recorder"]

_PATIENCE = 30.0
"""Seconds in which saving has to be done."""


class Recorder:
    """Records from its making until it is closed. Raises StartError where nothing can be written."""

    def __init__(self, running: Running, settings: RecordSettings) -> None:
        self._running = running
        self._channels = Channels()
        self._program = running.program
        self._known = Classifier(self._program.envelope, self._program.table)
        directory = open_directory(settings, running.program.table.path.stem)
        self._continuous = Continuous(settings, directory, self._channels, self._about) if settings.continuous else None
        self._saving = (
            Saving(settings.last, settings.max_size, directory, self._channels, self._about)
            if settings.last is not None
            else None
        )
        self._intake = Intake(self._continuous, Encoder(self._channels)) if self._continuous is not None else None
        self._packer = Packer()
        self._trips: deque[str] = deque()
        self._saves: deque[tuple[str, Future[Path]]] = deque()
        self._alarm = WakeEvent()
        self._asking = threading.Lock()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()
        self._detach = running.mirror.attach(self._take)

    def save(self, reason: str) -> Path:
        """Has what is in memory written to a file of its own. Any thread may ask; raises RecordError."""
        if self._saving is None:
            raise RecordError("nothing is kept in memory: the table's `record` has no `last`")
        done: Future[Path] = Future()
        with self._asking:
            if self._closing:
                raise RecordError("the router is stopping")
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
        continuous, intake = self._continuous, self._intake

        def dropped() -> list[tuple[tuple[str], float]]:
            return [
                (("overflow",), intake.overflow if intake else 0),
                (("write_error",), continuous.lost if continuous else 0),
            ]

        return {
            "recorded_datagrams": lambda: [((), continuous.datagrams if continuous else 0)],
            "recorded_bytes": lambda: [((), continuous.bytes if continuous else 0)],
            "record_dropped": dropped,
        }

    def close(self) -> None:
        """Writes all that was received, and finishes the file."""
        self._detach()
        with self._asking:  # what was asked for before is done in the last turn
            self._closing = True
        self._wake()
        self._thread.join()
        self._alarm.close()

    def _wake(self) -> None:
        with suppress(ValueError):  # it has ended
            self._alarm.set()

    def _take(self, batch: Sequence[Mirrored]) -> None:
        """Called by the mirror's thread."""
        known, wall, monotonic = self._known_now(), wall_ns(), monotonic_ns()
        if self._intake is not None:
            self._intake.add(batch, known, wall, monotonic)
        if self._saving is not None:
            self._saving.add(self._packer.pack(batch, known, wall, monotonic))

    def _known_now(self) -> Classifier:
        """A reload may have changed it."""
        program = self._running.program
        if program is not self._program:
            self._program, self._known = program, Classifier(program.envelope, program.table)
        return self._known

    def _run(self) -> None:
        while not self._closing:
            self._alarm.wait(self._intake.due - monotonic_ns() if self._intake is not None else PERIOD)
            self._turn()
        self._turn(is_last=True)
        if self._continuous is not None:
            self._continuous.close()

    def _turn(self, is_last: bool = False) -> None:
        """Nothing leaves it: a fault is told, and is no reason to stop recording."""
        if self._intake is not None:
            self._intake.write()
        while self._saves:
            self._save(*self._saves.popleft(), is_last)
        if self._trips and self._saving is not None and (is_last or self._saving.may_save_trips(monotonic_ns())):
            routes = sorted({self._trips.popleft() for _ in range(len(self._trips))})
            self._save(f"deadman-{routes[0]}", Future(), is_last)

    def _save(self, reason: str, done: Future[Path], is_last: bool) -> None:
        """Whatever comes of it, `done` is told. What is received meanwhile is written as ever."""
        assert self._saving is not None  # noqa: S101 - who asks, and deadmen, look before
        try:
            done.set_result(self._saving.save(reason, self._writing, None if is_last else self._write_if_due))
        except RecordError as error:  # it has been logged
            done.set_exception(error)
        except Exception as error:  # noqa: BLE001 a fault of the router
            logger.critical("a fault in the recorder kept it from saving; please report it", exc_info=error)
            done.set_exception(RecordError(f"a fault in the router itself: {error!r}"))

    def _write_if_due(self) -> None:
        if self._intake is not None:
            self._intake.write_if_due()

    def _writing(self) -> Path | None:
        return self._continuous.path if self._continuous is not None else None

    def _about(self, reason: str = "continuous") -> dict[str, str]:
        """What a file says of itself."""
        program = self._running.program
        return {"reason": reason, "table": program.table.path.name, "protos_sha256": program.protos_sha256}

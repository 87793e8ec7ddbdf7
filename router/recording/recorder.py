"""The recorder: writes datagrams and actions of the mirror to disk, and keeps the newest in memory to save on request.

The thread `recorder` encodes and writes them, those in memory when they are saved.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotInTime
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from router.clock import boottime_ns, wall_ns
from router.compiler.compiled_table import CompiledTable
from router.errors import RouterError
from router.log import fault, logger
from router.recording.about import about, reason_of
from router.recording.channels import Channels
from router.recording.encoder import Batch, Encoder, Packer
from router.recording.incidents import Incident, Incidents
from router.recording.mirror import Acted, Classifier, Mirror, Mirrored, Taken
from router.recording.writer import LONGEST_CHUNK, ContinuousWriter, MessageWriter, RecordingDirectory
from router.table.model.settings import RecordSettings
from router.threads import Thread, WakeEvent

PERIOD = 500_000_000
"""ns from chunk to chunk. A kill loses this much, or more if the disk is slow."""

MOST_QUEUED = 64 << 20
"""Maximum bytes of batches in the queue to the disk. Those in memory for `last` are not in it."""

AFTERMATH = 2_000_000_000
"""ns from a stop until its recording is saved, which then has the brakes, their effect, and further deadmen."""

LONGEST_AFTERMATH = 10_000_000_000
"""Likewise, if boards have not answered."""

STOP_SECONDS = 2.5
"""How long shutting down waits for the disk. A service manager kills the router after 10 s, and more must be closed."""

MOST_AT_STOP = 2 << 20
"""Maximum bytes of batches that are saved while shutting down: 100,000 datagrams, which take up to 2 s."""

_PATIENCE, _MOMENT = 30.0, 1.0
"""Timeouts, s: of `save`, and of having the mirror deliver what led to a stop."""

_FOREVER = 2**62
"""ns."""


class RecordError(RouterError):
    """The last datagrams could not be saved; the message says why."""


class Ring:
    """The batches of the last `last` ns, at most `most` bytes in total: in a flood they cover less time."""

    def __init__(self, last: int, most: int) -> None:
        self._last = last
        self._most = most
        self._batches: deque[Batch] = deque()
        self._size = 0

    def add(self, batch: Batch) -> None:
        self._batches.append(batch)
        self._size += batch.size
        oldest = batch.monotonic - self._last
        while self._batches[0].monotonic < oldest or (self._size > self._most and len(self._batches) > 1):
            self._size -= self._batches.popleft().size

    def batches(self, most: int | None = None) -> list[Batch]:
        """Return the batches, oldest first; only the newest ones if they have more than `most` bytes."""
        batches = list(self._batches)
        size = self._size
        while most is not None and size > most and len(batches) > 1:
            size -= batches.pop(0).size
        return batches


@dataclass(slots=True)
class _Trip:
    """A deadman that has tripped: the route, the boards that have not answered yet, and the answers.

    `at` is on the wall clock, `tripped_at` on the boot clock, ns.
    """

    route: str
    awaited: set[str]
    at: int
    tripped_at: int
    answers: list[str] = field(default_factory=list)


class Recorder:
    """Records from creation until it is closed. Raises StartError if the directory is not writable.

    `program` returns the running program, which a reload replaces.
    """

    def __init__(self, mirror: Mirror, program: Callable[[], CompiledTable], settings: RecordSettings) -> None:
        self._mirror = mirror
        self._running_program = program
        self._settings = settings
        self._program = program()
        self._classifier = Classifier(self._program.envelopes, self._program.table)
        self._channels = Channels()
        self._packer = Packer()
        self._queue: deque[Batch] = deque()  # for continuous recording
        self._queued = 0  # bytes
        self._taking = threading.Lock()  # for both, and the ring
        self._directory = RecordingDirectory(settings, self._program.table.path.stem)
        self._continuous = (
            ContinuousWriter(settings, self._directory, self._channels, lambda: self._about("continuous"))
            if settings.continuous
            else None
        )
        self._ring = Ring(settings.last, settings.max_size) if settings.last is not None else None
        self._incidents = Incidents(self._write_incident)
        self._overflow = 0
        self._is_writing = True
        self._due = boottime_ns() + PERIOD
        self._trips: list[_Trip] = []
        self._tripping = threading.Lock()  # for the trips
        self._trips_saved_at: int | None = None
        self._requests: deque[tuple[str, Future[Path]]] = deque()
        self._requesting = threading.Lock()
        self._closing = False
        self._wake_up = WakeEvent()
        self._thread = Thread(self._run, "recorder")  # a disk may hang
        self._thread.start()
        self._detach = mirror.keep(self._take)

    def save(self, reason: str) -> Path:
        """Write all datagrams until now that are in memory to a new file, and return its path. Thread-safe.

        Raises RecordError.
        """
        if self._ring is None:
            raise RecordError("nothing is kept in memory: give the table's `record` a `last`")
        if not self._mirror.deliver(_PATIENCE):
            raise RecordError("an observer of datagrams hangs")
        done: Future[Path] = Future()
        with self._requesting:
            if self._closing:
                raise RecordError("the router is shutting down")
            self._requests.append((reason, done))
        self._wake()
        try:
            return done.result(_PATIENCE)
        except NotInTime:
            raise RecordError(f"saving takes longer than {_PATIENCE:.0f} s") from None

    def deadman_tripped(self, route: str, awaited: Iterable[str] = ()) -> None:
        """Request to save what is in memory after AFTERMATH and the answers of `awaited` boards. Returns at once."""
        if self._ring is not None:
            with self._tripping:
                self._trips.append(_Trip(route, set(awaited), wall_ns(), boottime_ns()))
            self._wake()

    def board_answered(self, route: str, board: str, answer: str) -> None:
        """Note whether a board obeys the deadman of a route, for the metadata of the file that is saved then."""
        with self._tripping:
            for trip in self._trips:
                if trip.route == route and board in trip.awaited:
                    trip.awaited.remove(board)
                    trip.answers.append(f"{route}: {board} {answer}")

    def deadman_released(self, route: str) -> None:
        """Wait for no more answers to a deadman."""
        with self._tripping:
            for trip in self._trips:
                if trip.route == route:
                    trip.awaited.clear()
            self._wake()

    def samples(self) -> Mapping[str, Sequence[tuple[tuple[str, ...], float]]]:
        """Return the metrics of the recorder: for each its label values and values."""
        continuous = self._continuous
        write_errors = self._incidents.dropped + (continuous.lost if continuous else 0)
        return {
            "recorded_datagrams": [((), continuous.datagrams if continuous else 0)],
            "recorded_bytes": [((), continuous.bytes if continuous else 0)],
            "record_dropped": [(("overflow",), self._overflow), (("write_error",), write_errors)],
            "recordings_unsaved": [((reason,), number) for reason, number in self._incidents.unsaved.items()],
            "recordings_lost": [((), self._incidents.lost)],
        }

    def close(self) -> None:
        """Write everything received and finish the file, or as much as the disk accepts within STOP_SECONDS."""
        self._detach()
        with self._requesting:  # the last turn serves earlier requests
            self._closing = True
        self._wake()
        self._thread.join(STOP_SECONDS)
        if self._thread.is_alive():
            event = "the disk is too slow to finish the recordings; the parts already written are readable"
            logger.error(event, directory=str(self._directory.path))
        else:
            self._wake_up.close()

    def _wake(self) -> None:
        with suppress(ValueError):  # it is closed
            self._wake_up.set()

    def _take(self, datagrams: Taken[Mirrored], actions: Taken[Acted]) -> None:
        """Queue what the mirror has taken. Called by the mirror."""
        if not datagrams.records and not actions.records:
            return
        program = self._running_program()
        if program is not self._program:
            self._program, self._classifier = program, Classifier(program.envelopes, program.table)
        batch = self._packer.pack(datagrams, actions, self._classifier, wall_ns(), boottime_ns())
        with self._taking:
            if self._ring is not None:
                self._ring.add(batch)
            if self._continuous is None:
                return
            if self._queued + batch.size > MOST_QUEUED:
                self._overflow += batch.count()
            else:
                self._queue.append(batch)
                self._queued += batch.size

    def _next_batches(self) -> list[Batch]:
        """Take the batches of the next chunk from the queue."""
        batches: list[Batch] = []
        size = 0
        with self._taking:
            while self._queue and size < LONGEST_CHUNK:
                batches.append(self._queue.popleft())
                size += batches[-1].size
            self._queued -= size
        return batches

    def _run(self) -> None:
        while not self._closing:
            self._wake_up.wait(self._due - boottime_ns() if self._has_to_look() else _FOREVER)
            if self._continuous is not None:
                self._mirror.deliver(0)  # it does so less often
            self._write()
            self._save_requested()
            if self._trips and self._are_trips_due():
                self._take_trips()
            self._incidents.save(boottime_ns())
        self._write()
        if self._continuous is not None:
            self._continuous.close()
        self._save_requested()
        if self._trips:
            self._take_trips()
        self._incidents.save(boottime_ns(), at_once=True)
        self._incidents.give_up()

    def _has_to_look(self) -> bool:
        """Return whether something may be due without a wake-up."""
        return self._continuous is not None or bool(self._trips) or self._incidents.is_waiting

    def _write(self) -> None:
        """Write all queued batches."""
        self._due = boottime_ns() + PERIOD
        if self._continuous is None:
            return
        while batches := self._next_batches():
            try:
                self._continuous.write(batches, boottime_ns())
            except Exception as error:  # noqa: BLE001 a fault of the router; keep recording
                self._report(error)
            else:
                self._is_writing = True
        self._continuous.close_if_old(boottime_ns())

    def _report(self, error: Exception) -> None:
        """Log the first of several faults."""
        if self._is_writing:
            fault(error, "lost datagrams", "the recorder").log()
        self._is_writing = False

    def _save_requested(self) -> None:
        while self._requests:
            reason, done = self._requests.popleft()
            try:
                done.set_result(self._save(reason))
            except RecordError as error:
                done.set_exception(error)

    def _are_trips_due(self) -> bool:
        """Return True at most once per `last`: then nothing is missed, and frequent trips do not fill the disk."""
        assert self._settings.last is not None  # noqa: S101 - `deadman_tripped` checks
        now = boottime_ns()
        with self._tripping:
            waited = now - self._trips[0].tripped_at
            is_awaiting = waited < LONGEST_AFTERMATH and any(trip.awaited for trip in self._trips)
        is_recent = self._trips_saved_at is not None and now - self._trips_saved_at < self._settings.last
        if is_recent or is_awaiting or waited < AFTERMATH:
            return False
        self._trips_saved_at = now
        return True

    def _take_trips(self) -> None:
        """Keep what is in memory until it is saved."""
        assert self._ring is not None  # noqa: S101 - `deadman_tripped` checks
        with self._tripping:
            trips, self._trips = self._trips, []
        self._mirror.deliver(_MOMENT)
        self._write()
        try:
            routes = [*dict.fromkeys(trip.route for trip in trips)]
            answers = "; ".join(answer for trip in trips for answer in trip.answers)
            metadata = {**self._about(reason_of(routes), routes), **({"obeyed": answers} if answers else {})}
            data, datagrams = self._encoded(metadata)
            self._incidents.add(Incident(routes, trips[0].at, data, datagrams))
        except Exception as error:  # noqa: BLE001 as in `_write`
            fault(error, "prevented saving", "the recorder").log()

    def _write_incident(self, incident: Incident) -> None:
        self._write_file(incident.data, incident.reason, incident.at)

    def _save(self, reason: str) -> Path:
        """Write the ring to a file, and return its path. Raises RecordError, which has been logged."""
        assert self._ring is not None  # noqa: S101 - `save` checks
        self._write()
        try:
            return self._write_file(self._encoded(self._about(reason))[0], reason, wall_ns())
        except OSError as error:
            logger.error("cannot save the last datagrams", reason=reason, problem=error.strerror)
            raise RecordError(f"cannot write to {self._directory.path}: {error.strerror}") from error
        except Exception as error:
            stopped = fault(error, "prevented saving", "the recorder")
            stopped.log()
            raise RecordError(f"{stopped.event}: {error!r}") from error

    def _encoded(self, about: Mapping[str, str]) -> tuple[bytes, int]:
        """Return a whole file of what is in memory, and the number of its datagrams.

        Meanwhile, continuous recording continues.
        """
        assert self._ring is not None  # noqa: S101 - callers check
        output, encoder = BytesIO(), Encoder(self._channels)
        file = MessageWriter(output, self._channels, about)
        with self._taking:
            batches = self._ring.batches()
            newest = self._ring.batches(MOST_AT_STOP) if self._closing else batches
        if len(newest) < len(batches):
            lost = f"{(newest[0].monotonic - batches[0].monotonic) / 1e9:.1f} s"
            logger.warning("the router stops, so it saves only the newest datagrams", left_out=lost)
        for batch in newest:
            file.add(encoder.messages(batch))
            if boottime_ns() >= self._due and not self._closing:
                self._write()
        file.finish()
        return output.getvalue(), encoder.datagrams

    def _write_file(self, data: bytes, reason: str, at: int) -> Path:
        """Write a whole file, or nothing. Raises OSError."""
        writing = self._continuous.path if self._continuous is not None else None
        reserve = self._settings.max_size if writing is not None else 0
        path = self._directory.save(data, reason, at, reserve, writing)
        logger.info("saved the last datagrams", reason=reason, file=str(path))
        return path

    def _about(self, reason: str, tripped: Sequence[str] = ()) -> dict[str, str]:
        """Return the metadata of a file."""
        program = self._running_program()
        return {**about(program.table, reason, tripped), "protos_sha256": program.protos_sha256}

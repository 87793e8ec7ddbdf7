"""Recordings of stops that are not on the disk yet. They stay in memory until the disk accepts them."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

from router.compiler.metrics import UNSAVED_REASONS
from router.errors import plural
from router.log import fault, logger
from router.recording.about import reason_of

RETRY = 10_000_000_000
"""ns until the next attempt after a disk error."""

MOST_UNSAVED = 64 << 20
"""Maximum bytes of unsaved recordings in memory; but the last one is kept, whatever its size."""

_REASONS = {
    errno.ENOSPC: "disk_full",
    errno.EDQUOT: "disk_full",
    errno.EROFS: "read_only",
    errno.EACCES: "no_permission",
    errno.EPERM: "no_permission",
}
_OTHER = "disk_error"
"""One of UNSAVED_REASONS by errno, and the one for all others."""


@dataclass(slots=True, eq=False)
class Incident:
    """A recording that the deadmen `tripped` caused. `at`: when the first one did (wall clock, ns).

    `data` is the whole file, which has this number of `datagrams`.
    """

    tripped: Sequence[str]
    at: int
    data: bytes
    datagrams: int

    @property
    def reason(self) -> str:
        return reason_of(self.tripped)


class Incidents:
    """Saves recordings of stops, oldest first, by `write`, which raises OSError. For one thread.

    `unsaved` are the numbers of waiting recordings by reason, `lost` the number of lost ones, `dropped` the number of
    datagrams in them.
    """

    def __init__(self, write: Callable[[Incident], None]) -> None:
        self.unsaved = dict.fromkeys(UNSAVED_REASONS, 0)
        self.lost = self.dropped = 0
        self._write = write
        self._waiting: list[Incident] = []
        self._retry_at: int | None = None

    @property
    def is_waiting(self) -> bool:
        return bool(self._waiting)

    def add(self, incident: Incident) -> None:
        """Add a recording; it is saved by the next call of `save`."""
        self._waiting.append(incident)

    def save(self, now: int, *, at_once: bool = False) -> None:
        """Save what is waiting. After an error of the disk only every RETRY, except `at_once`. Errors are logged."""
        if not self._waiting or (not at_once and self._retry_at is not None and now < self._retry_at):
            return
        problem: OSError | None = None
        while self._waiting and problem is None:
            problem = self._save(self._waiting[0])
        self.unsaved = dict.fromkeys(UNSAVED_REASONS, 0)
        if problem is None:
            self._retry_at = None
            return
        if self._retry_at is None:
            event = "cannot save the recording of a stop; it stays in memory, and the router retries every 10 s"
            remedy = "repair the disk or free space before stopping the router"
            logger.error(event, reason=self._waiting[0].reason, problem=problem.strerror, remedy=remedy)
        self._retry_at = now + RETRY
        self._limit()
        self.unsaved[_REASONS.get(problem.errno or 0, _OTHER)] = len(self._waiting)

    def give_up(self) -> None:
        """Log what was not saved. Call this at shutdown."""
        for incident in self._waiting:
            self._lose(incident, "the router stops")
        self._waiting.clear()

    def _save(self, incident: Incident) -> OSError | None:
        """Save a recording, and forget it. Return the error if the disk does not accept it."""
        try:
            self._write(incident)
        except OSError as error:
            return error
        except Exception as error:  # noqa: BLE001 a fault of the router, which would recur
            fault(error, "prevented saving", "the recorder").log()
            self._lose(incident, repr(error))
        self._waiting.remove(incident)
        return None

    def _limit(self) -> None:
        """Lose the oldest recordings if they need too much memory."""
        while len(self._waiting) > 1 and sum(len(incident.data) for incident in self._waiting) > MOST_UNSAVED:
            oldest = self._waiting.pop(0)
            self.dropped += oldest.datagrams
            self._lose(oldest, "newer ones need the memory")

    def _lose(self, incident: Incident, why: str) -> None:
        self.lost += 1
        at = datetime.fromtimestamp(incident.at / 1e9, timezone.utc).isoformat(timespec="milliseconds")
        datagrams = plural(incident.datagrams, "datagram")
        event = "the recording of a stop is lost: it could not be written"
        logger.error(event, reason=incident.reason, stopped_at=at, had=datagrams, why=why)

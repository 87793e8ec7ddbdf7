"""What waits to be recorded continuously, from the mirror's thread to the recorder's.

Knows what memory it may take, and what a fault costs; files and chunks are made by others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from router.clock import monotonic_ns
from router.log import logger
from router.recording.continuous import Continuous
from router.recording.encoding import Encoder
from router.recording.mirror import Classifier, Mirrored
from router.recording.saving import LONGEST_CHUNK

PERIOD = 500_000_000
"""ns from chunk to chunk: what a kill costs, with what the mirror still has; more only where the disk is slow."""

MOST_WAITING = 64 << 20
"""Bytes that may wait for a disk that is slow."""

_BESIDE_DATA = 256
"""About what Python needs for a datagram beside its data, in bytes."""


class _Batch(NamedTuple):
    datagrams: Sequence[Mirrored]
    known: Classifier
    wall: int
    monotonic: int
    size: int


class Intake:
    """`add` is for one thread, all else for another. `overflow` counts datagrams that there was no room for."""

    def __init__(self, continuous: Continuous, encoder: Encoder) -> None:
        self.overflow = 0
        self.due = monotonic_ns() + PERIOD
        """When `write` is to be called next."""
        self._continuous = continuous
        self._encoder = encoder
        self._known: Classifier | None = None
        self._waiting: deque[_Batch] = deque()
        self._taken_in = self._taken_out = 0  # bytes, each written by one thread
        self._is_well = True

    def add(self, datagrams: Sequence[Mirrored], known: Classifier, wall: int, monotonic: int) -> None:
        size = sum([len(data) for _, _, _, data in datagrams]) + _BESIDE_DATA * len(datagrams)
        if self._taken_in - self._taken_out + size > MOST_WAITING:
            self.overflow += len(datagrams)
            return
        self._taken_in += size
        self._waiting.append(_Batch(datagrams, known, wall, monotonic, size))

    def write_if_due(self) -> None:
        if monotonic_ns() >= self.due:
            self.write()

    def write(self) -> None:
        """All that waits. What a fault loses is counted as what a disk loses, and the rest goes on."""
        now = monotonic_ns()
        self.due = now + PERIOD
        found: list[Exception | None] = []
        for _ in range(len(self._waiting)):
            batch = self._waiting.popleft()
            self._taken_out += batch.size
            found.append(self._fault(batch, now))
        faults = [error for error in (*found, self._fault(None, now)) if error is not None]
        if faults and self._is_well:
            logger.critical("a fault in the recorder lost datagrams; please report it", exc_info=faults[0])
        if found:
            self._is_well = not faults

    def _fault(self, batch: _Batch | None, now: int) -> Exception | None:
        """What went wrong when this was encoded; or, where it is None, when all that was encoded was written."""
        try:
            if batch is not None:
                self._encode(batch)
            if batch is None or self._encoder.offset > LONGEST_CHUNK:
                if (chunk := self._encoder.take()) is not None:
                    self._continuous.write(chunk, now)
                self._continuous.close_if_old(now)
        except Exception as error:  # noqa: BLE001 of the router itself, and no reason to stop recording
            self._continuous.lost += self._encoder.drop()
            return error
        return None

    def _encode(self, batch: _Batch) -> None:
        if batch.known is not self._known:
            self._encoder.know(batch.known)
            self._known = batch.known
        self._encoder.add(batch.datagrams, batch.wall, batch.monotonic)

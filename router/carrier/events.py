"""Reads what native threads tell: rejected datagrams, lost messages, and what deadmen do."""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from socket import inet_ntoa
from struct import Struct

from router.carrier.outlets import Names
from router.carrier.ring import Ring
from router.carrier.structures import LOSSES, NO_NAME
from router.compiler.metrics import REJECT_REASONS, Report
from router.threads import Thread, join_or_leave

_TRIPPED, _RELEASED, _DEADMAN_ERROR, _REJECTED, _LOST = range(1, 6)
"""`enum event_kind`."""

_REASONS = tuple(REJECT_REASONS)
_HEAD = Struct("@II")
_DEADMAN = Struct("@IIIIiI")
_REJECT = Struct("@IIIIIIII")
_LOSS = Struct("@IIIIIIiIII")

_PULSE_MS = 5000


@dataclass(frozen=True, slots=True)
class Changed:
    """The deadman of a route has tripped, or was released."""

    route: str
    is_tripped: bool


@dataclass(frozen=True, slots=True)
class Told:
    """A loss, by the counter of such losses."""

    counter: int
    report: Report


class EventReader:
    """Puts records of `native/events.h` into words.

    `detail(listener, data, length)` returns in words why a datagram was rejected. `place(route, topic, target,
    generation, place)` returns which place of the table refused a message of `topic`, None of a datagram; or "".
    """

    def __init__(
        self,
        names: Names,
        detail: Callable[[str, bytes, int], str],
        place: Callable[[str, str | None, str, int, int], str],
    ) -> None:
        self._name = names.name
        self._detail = detail
        self._place = place

    def read(self, kind: int, record: memoryview) -> Changed | Told:
        if kind in {_TRIPPED, _RELEASED}:
            _, _, route, _, _, _ = _DEADMAN.unpack_from(record)
            return Changed(self._name(route), kind == _TRIPPED)
        if kind == _REJECTED:
            return self._rejected(record)
        if kind == _LOST:
            return self._lost(record)
        _, _, route, target, number, counter = _DEADMAN.unpack_from(record)
        error = _error(number) or OSError(f"it cannot be published: {_text(record[_DEADMAN.size :])}")
        return Told(counter, Report("deadman", self._name(route), self._name(target), "send_error", error))

    def _rejected(self, record: memoryview) -> Told:
        _, _, listener, reason, address, port, length, counter = _REJECT.unpack_from(record)
        place, data = self._name(listener), bytes(record[_REJECT.size : _REJECT.size + length])
        sender = f"from {inet_ntoa(address.to_bytes(4, 'big'))}:{port}"
        what = self._detail(place, data, length)
        detail = f"{sender}: {what}" if what else sender
        return Told(counter, Report("reject", place, "", _REASONS[reason], None, detail))

    def _lost(self, record: memoryview) -> Told:
        _, _, of_route, of_topic, of_target, loss, number, counter, generation, place = _LOSS.unpack_from(record)
        route, target = self._name(of_route), self._name(of_target)
        detail = _text(record[_LOSS.size :])
        if generation:  # a program of the table refused the message
            topic = self._name(of_topic) if of_topic != NO_NAME else None
            detail = ": ".join(filter(None, (self._place(route, topic, target, generation, place), detail)))
        return Told(counter, Report("drop", route, target, LOSSES[loss], _error(number), detail))


class EventThread:
    """Reads the events of `rings`, and calls `pulse` every few seconds to say that Python is alive.

    Each ring comes with the counters of those who write to it. Of many losses of a kind, few are events; by the counter
    that an event names, `report` is told of all of them. `changed` gets a route and whether its deadman has tripped.
    """

    def __init__(
        self,
        rings: Sequence[tuple[Ring, Sequence[int]]],
        reader: EventReader,
        report: Callable[[Report], None],
        changed: Callable[[str, bool], None],
        pulse: Callable[[], None],
    ) -> None:
        self._rings = rings
        self._reader = reader
        self._report = report
        self._changed = changed
        self._pulse = pulse
        self._stopping = False
        self._last: list[dict[int, tuple[int, Report]]] = [{} for _ in rings]
        """By ring and counter: how much of it was reported, and the last report."""
        self._wakes = [ring.watch() for ring, _ in rings]
        self._thread = Thread(self._run, "carrier events")
        self._thread.start()

    def close(self) -> None:
        """Read what has been told, and end."""
        self._stopping = True
        os.eventfd_write(self._wakes[0], 1)
        join_or_leave(self._thread)

    def _run(self) -> None:
        poll = select.poll()
        for wake in self._wakes:
            poll.register(wake, select.POLLIN)
        while not self._stopping:
            for wake, _ in poll.poll(_PULSE_MS):
                os.eventfd_read(wake)
            self._pulse()
            self._read()
        self._read()

    def _read(self) -> None:
        for (ring, counters), last in zip(self._rings, self._last, strict=True):
            while records := ring.take():
                position = 0
                while position < len(records):
                    size, kind = _HEAD.unpack_from(records, position)
                    self._tell(kind, records[position : position + size], counters, last)
                    position += size
            for counter, (_, report) in list(last.items()):  # those for which no event was written
                self._count(counter, report, counters, last)

    def _tell(
        self, kind: int, record: memoryview, counters: Sequence[int], last: dict[int, tuple[int, Report]]
    ) -> None:
        match self._reader.read(kind, record):
            case Changed(route, is_tripped):
                self._changed(route, is_tripped)
            case Told(counter, report):
                self._count(counter, report, counters, last)

    def _count(
        self, counter: int, report: Report, counters: Sequence[int], last: dict[int, tuple[int, Report]]
    ) -> None:
        """Report what was counted since the last report by this counter."""
        total = counters[counter]
        reported = last[counter][0] if counter in last else 0
        if total < reported:  # the counter has gone with a table, and stands for something else
            reported = 0
        last[counter] = total, report
        if total > reported:
            self._report(replace(report, times=total - reported))


def _error(number: int) -> OSError | None:
    return OSError(number, os.strerror(number)) if number else None


def _text(record: memoryview) -> str:
    return bytes(record).partition(b"\0")[0].decode(errors="replace")

"""Reads what native threads tell: rejected datagrams, lost messages, and what deadmen do."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable, Sequence
from socket import inet_ntoa
from struct import Struct

from router.carrier.program import Names
from router.carrier.ring import Ring
from router.compiler.metrics import REJECT_REASONS
from router.engine.delivery import Report

_TRIPPED, _RELEASED, _DEADMAN_ERROR, _REJECTED, _LOST = range(1, 6)
"""`enum event_kind`."""

_LOSSES = (
    "mapping_error",
    "non_finite",
    "stale",
    "rate_limited",
    "queue_full",
    "send_buffer_full",
    "send_error",
)
"""`enum loss`."""

_REASONS = tuple(REJECT_REASONS)
_HEAD = Struct("@II")
_DEADMAN = Struct("@IIIIiI")
_REJECT = Struct("@IIIIIIII")
_LOSS = Struct("@IIIIIi")

_PULSE_MS = 5000


class EventThread:
    """Reads the events of `rings`, and calls `pulse` every few seconds to say that Python is alive.

    `report` gets losses, `changed` a route and whether its deadman has tripped. `detail(listener, data, length)`
    returns in words why a datagram was rejected.
    """

    def __init__(
        self,
        rings: Sequence[Ring],
        names: Names,
        report: Callable[[Report], None],
        changed: Callable[[str, bool], None],
        detail: Callable[[str, bytes, int], str],
        pulse: Callable[[], None],
    ) -> None:
        self._rings = rings
        self._name = names.name
        self._report = report
        self._changed = changed
        self._detail = detail
        self._pulse = pulse
        self._stopping = False
        self._wakes = [ring.watch() for ring in rings]
        self._thread = threading.Thread(target=self._run, name="carrier events", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Read what has been told, and end."""
        self._stopping = True
        os.eventfd_write(self._wakes[0], 1)
        self._thread.join()

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
        for ring in self._rings:
            while records := ring.take():
                position = 0
                while position < len(records):
                    size, kind = _HEAD.unpack_from(records, position)
                    self._tell(kind, records[position : position + size])
                    position += size

    def _tell(self, kind: int, record: memoryview) -> None:
        if kind == _REJECTED:
            _, _, listener, reason, address, port, length, _ = _REJECT.unpack_from(record)
            place, data = self._name(listener), bytes(record[_REJECT.size : _REJECT.size + length])
            sender = f"from {inet_ntoa(address.to_bytes(4, 'big'))}:{port}"
            what = self._detail(place, data, length)
            self._report(Report("reject", place, "", _REASONS[reason], None, f"{sender}: {what}" if what else sender))
        elif kind == _LOST:
            _, _, route, target, loss, number = _LOSS.unpack_from(record)
            error = OSError(number, os.strerror(number)) if number else None
            self._report(Report("drop", self._name(route), self._name(target), _LOSSES[loss], error))
        else:
            _, _, route, target, number, _ = _DEADMAN.unpack_from(record)
            if kind == _DEADMAN_ERROR:
                error = OSError(number, os.strerror(number))
                self._report(Report("deadman", self._name(route), self._name(target), "send_error", error))
            else:
                self._changed(self._name(route), kind == _TRIPPED)

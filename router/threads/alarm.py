"""What a thread waits for: that another one rings, or that some time has passed. Knows neither thread."""

from __future__ import annotations

import os
import select
import sys

_LONGEST_WAIT_MS = 3_600_000


class Alarm:
    """As threading.Condition, but the time is monotonic for certain.

    Python's locks count it by the wall clock where Python was built for a C library older than glibc 2.30, as many
    portable builds are; with a clock that is set back by an hour, who waits for one would sleep for an hour.
    """

    def __init__(self) -> None:
        self._rung = os.fdopen(os.eventfd(0), "r+b", buffering=0)
        self._poll = select.poll()
        self._poll.register(self._rung, select.POLLIN)

    def wait(self, nanoseconds: int) -> None:
        """Never ends early unless somebody rings, or has rung since the last wait; or after an hour."""
        if self._poll.poll(min(max(0, nanoseconds) / 1e6, _LONGEST_WAIT_MS)):
            self._rung.read(8)

    def ring(self) -> None:
        self._rung.write((1).to_bytes(8, sys.byteorder))

    def close(self) -> None:
        """Nobody may wait or ring any more; closing again changes nothing."""
        self._rung.close()

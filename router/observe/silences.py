"""Measures how long endpoints have been silent."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from router.clock import boottime_ns, wall_ns


class Silences:
    """Measures on the boot clock how long endpoints have been silent, or have not been heard yet. Thread-safe.

    The stamps of their last datagrams are wall time, and that clock may be set at any time: a new stamp counts from
    when it was first seen here, minus its age if that is plausible. Keep one for the whole run of a router.
    """

    def __init__(self, boot_ns: Callable[[], int] = boottime_ns, wall: Callable[[], int] = wall_ns) -> None:
        self._boot_ns, self._wall_ns = boot_ns, wall
        self._last: dict[str, tuple[int, int]] = {}  # by endpoint: its stamp, and that time on the boot clock
        self._looked = boot_ns()
        self._lock = threading.Lock()

    def of(self, stamps: Mapping[str, int]) -> Mapping[str, float]:
        """Return the silence (s) of each endpoint, given the stamps (ns; 0: not heard) of the present endpoints."""
        with self._lock:
            now, wall = self._boot_ns(), self._wall_ns()
            for endpoint, stamp in stamps.items():
                if endpoint not in self._last or self._last[endpoint][0] != stamp:
                    age = min(max(0, wall - stamp), now - self._looked)
                    self._last[endpoint] = stamp, now - age
            self._looked = now
            self._last = {endpoint: last for endpoint, last in self._last.items() if endpoint in stamps}
            return {endpoint: (now - then) / 1e9 for endpoint, (_, then) in self._last.items()}

"""The common part of native threads: an array of counters, and a ring for events."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from threading import Lock

from router.carrier.ring import Ring


class NativeThread:
    """A thread that counts in `counts` and writes to `events`.

    `_address` is that of its structure, 0 while there is none; `copy` is the C function that copies its counters.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        counts: ctypes.Array[ctypes.c_int64],
        events: Ring,
        copy: Callable[..., None] | None = None,
    ) -> None:
        self.counts = counts
        self.events = events
        self._library = library
        self._copy = copy
        self._in_use = Lock()  # for callers while another thread may stop it
        self._address = 0

    def counters(self, count: int) -> ctypes.Array[ctypes.c_int64]:
        """Return a copy of the first `count` counters, as a snapshot between two messages."""
        with self._in_use:
            if self._copy is None or not self._address:
                return (ctypes.c_int64 * count).from_buffer_copy(self.counts)
            copied = (ctypes.c_int64 * count)()
            self._copy(self._address, copied, count)
        return copied

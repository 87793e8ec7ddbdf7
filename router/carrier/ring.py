"""Rings: bounded queues of records from a native thread to a Python one, which drop the oldest record when full."""

from __future__ import annotations

import ctypes
from mmap import MAP_PRIVATE, mmap

from router.declared import MAX_DATAGRAM, MessageRecord

LONGEST_RECORD = ctypes.sizeof(MessageRecord) + MAX_DATAGRAM + 8


class Ring:
    """A ring for `capacity` bytes, a power of two. It is never closed: native threads may hold it until the end."""

    def __init__(self, library: ctypes.CDLL, capacity: int) -> None:
        """Raises MemoryError, also for a lack of descriptors, or OSError."""
        self._library = library
        self.address: int = library.ring_open(capacity)
        if not self.address:
            raise MemoryError("a queue of the carrier cannot be opened")
        pages = mmap(-1, max(1 << 16, 2 * LONGEST_RECORD), flags=MAP_PRIVATE)  # uses no memory until a record arrives
        self._records = (ctypes.c_char * len(pages)).from_buffer(pages)
        self._view = memoryview(self._records).cast("B")

    def take(self) -> memoryview:
        """Return whole records, the oldest first, valid until the next call. Not thread-safe."""
        size = self._library.ring_take(self.address, self._records, len(self._records), 0)
        return self._view[:size]

    def wake(self) -> None:
        """End the wait of a reader."""
        self._library.ring_wake(self.address)

    def watch(self) -> int:
        """Return an eventfd that becomes readable with each new record from now on."""
        return int(self._library.ring_watch(self.address))

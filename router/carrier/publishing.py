"""The native thread that publishes on topics what their routes make of datagrams."""

from __future__ import annotations

import ctypes
from threading import Lock
from time import sleep

from router import declared as c
from router.carrier.ring import Ring
from router.clock import monotonic_ns

_POLL_S = 0.002


class PublishThread:
    """Delivers the messages of `ring` to topics. It starts at once, and stops once.

    `counters` is the array that it counts in; losses go to `events`. `functions` are the addresses of those in
    `ros.rcl.PublishFunctions`.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        ring: Ring,
        counters: ctypes.Array[ctypes.c_int64],
        events: Ring,
        functions: tuple[int, int, int],
    ) -> None:
        """Raises MemoryError, also for a lack of descriptors or threads."""
        self._library = library
        self._ring, self._counters, self._events = ring, counters, events
        self._in_use = Lock()  # for those who ask while it may be stopped
        self._address: int = library.publish_open(ring.address, counters, events.address, *functions)
        if not self._address:
            raise MemoryError("the thread that publishes cannot be started")

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two messages."""
        copy = (ctypes.c_int64 * count)()
        with self._in_use:
            if not self._address:
                return list(self._counters[:count])
            self._library.publish_counters(self._address, copy, count)
        return list(copy)

    def change(self, change: c.PublishChange) -> None:
        """Make a change of timers when its generation is reached: to be called before a message of that comes."""
        with self._in_use:
            if self._address:
                self._library.publish_change(self._address, ctypes.byref(change))

    def advance(self, generation: int) -> None:
        """Go on to that generation once all earlier messages are served: none of them can come any more."""
        with self._in_use:
            if self._address:
                self._library.publish_advance(self._address, generation)

    def wait_for(self, generation: int, timeout: float) -> bool:
        """Wait until nothing of earlier generations is in use. Return False after `timeout` s."""
        for _ in range(int(timeout / _POLL_S)):
            with self._in_use:
                if not self._address or self._library.publish_has_reached(self._address, generation):
                    return True
            sleep(_POLL_S)
        return False

    def stalled(self) -> tuple[int, float] | None:
        """The topic in whose publisher the thread is now, by its number, and for how many seconds; None if in none."""
        topic = ctypes.c_uint32()
        with self._in_use:
            since = self._library.publish_since(self._address, ctypes.byref(topic)) if self._address else 0
        return (topic.value, (monotonic_ns() - since) / 1e9) if since else None

    def stop(self) -> bool:
        """Serve what waits, and end.

        Return False if the thread is stuck in the middleware after 1 s: then it is left, and publishers must stay open.
        Idempotent.
        """
        with self._in_use:
            address, self._address = self._address, 0
        if not address:
            return self not in _left
        if not self._library.publish_stop(address):
            _left.append(self)
            return False
        return True


_left: list[PublishThread] = []
"""Those that were stuck when they were to end: they use their ring and their counters."""

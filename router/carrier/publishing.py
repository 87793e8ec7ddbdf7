"""The native thread that publishes datagrams on topics."""

from __future__ import annotations

import ctypes
from time import sleep

from router import declared as c
from router.carrier.ring import Ring
from router.carrier.threads import NativeThread
from router.clock import monotonic_ns
from router.errors import StartError
from router.image.names import Names

_POLL_S = 0.002


class PublishThread(NativeThread):
    """Delivers the messages of `ring` to topics. It starts once and stops once; other calls need no running thread.

    It counts deliveries, and writes losses to `events`.
    """

    def __init__(
        self, library: ctypes.CDLL, ring: Ring, counts: ctypes.Array[ctypes.c_int64], events: Ring, names: Names
    ) -> None:
        super().__init__(library, counts, events, library.publish_counters)
        self.name = "publish"
        self.ring = ring
        self._names = names

    def start(self, functions: tuple[int, int, int], first: c.PublishChange | None = None) -> None:
        """Start the thread if it is not running. `functions` are the addresses in `ros.rcl.PublishFunctions`.

        `first` is a change whose messages are already waiting; the caller keeps it alive until its generation has
        passed. Raises StartError if memory, descriptors or threads run out.
        """
        if self._address:
            return
        arguments = (
            self.ring.address,
            self.counts,
            self.events.address,
            *functions,
            ctypes.byref(first) if first else None,
        )
        self._address = int(self._library.publish_open(*arguments) or 0)
        if not self._address:
            raise StartError("the thread that publishes cannot be started")

    def change(self, change: c.PublishChange) -> None:
        """Change timers when the generation is reached. Call it before the first message of that generation.

        The caller keeps the change alive until then.
        """
        with self._in_use:
            if self._address:
                self._library.publish_change(self._address, ctypes.byref(change))

    def advance(self, generation: int) -> None:
        """Switch to that generation once all earlier messages are handled. No more earlier ones may be added."""
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

    def stalled(self) -> tuple[str, float] | None:
        """Return the topic on which the thread is publishing now, and for how many seconds; None if there is none."""
        topic = ctypes.c_uint32()
        with self._in_use:
            since = self._library.publish_since(self._address, ctypes.byref(topic)) if self._address else 0
        return (self._names.name(topic.value), (monotonic_ns() - since) / 1e9) if since else None

    def stop(self) -> bool:
        """Handle the waiting messages, and end the thread.

        Return False if it is stuck in the middleware after 1 s: then it keeps running, and publishers must stay open.
        Idempotent.
        """
        with self._in_use:
            address, self._address = self._address, 0
        if not address:
            return self not in _stuck
        if not self._library.publish_stop(address):
            _stuck.append(self)
            return False
        return True


_stuck: list[PublishThread] = []
"""Threads that were stuck at their end: they still use their ring and their counters."""

"""The native threads: receive, and timers."""

from __future__ import annotations

import ctypes
import os

from router import declared as c
from router.carrier.ring import Ring
from router.carrier.threads import NativeThread


class ForwardingThreads(NativeThread):
    """Receives datagrams and executes programs, in native threads that never wait for Python.

    `counts` is the array of the receive thread, which writes losses and rejections to `events`, and messages for topics
    to `published`. Deadmen are served when they are due.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        deadmen: int,
        counts: ctypes.Array[ctypes.c_int64],
        events: Ring,
        published: Ring,
    ) -> None:
        """Raises MemoryError."""
        super().__init__(library, counts, events, library.carrier_counters)
        self._published = published
        self._address = int(library.carrier_open(deadmen, counts, events.address, published.address) or 0)
        self._running: tuple[object, ...] = ()
        if not self._address:
            raise MemoryError("the carrier cannot be opened")

    @property
    def turns(self) -> int:
        """A number that grows at least every 50 ms unless the receive thread is stuck."""
        with self._in_use:
            return int(self._library.carrier_turns(self._address)) if self._address else 0

    def start(self, change: c.Change, *used: object) -> None:
        """Start the threads with a program. `used` is kept alive for it. Raises StartError."""
        if error := self._library.carrier_start(self._address, ctypes.byref(change)):
            from router.errors import StartError

            raise StartError(f"the carrier's threads cannot be started: {os.strerror(error)}")
        self._running = change, used

    def change(self, change: c.Change, *used: object) -> None:
        """Execute another program from the next datagram on. Listeners that it does not have are drained first."""
        self._library.carrier_change(self._address, ctypes.byref(change))
        self._running = change, used

    def mirror(self, ring: Ring | None, lost: int) -> None:
        """Mirror received datagrams to `ring` from now on. `lost` counts those dropped because it is full.

        Does nothing after `close`.
        """
        with self._in_use:
            if not self._address:
                return
            self._library.carrier_mirror(self._address, ring.address if ring else None, lost)

    def watchdog(self, notify: int, interval: int) -> None:
        """Feed a watchdog through the connected socket `notify` every `interval` ns, while receiving makes progress and
        `pulse` is called every few seconds."""
        self._library.carrier_watchdog(self._address, notify, interval)

    def pulse(self) -> None:
        self._library.carrier_pulse(self._address)

    def stop_receiving(self) -> None:
        """Handle the datagrams queued in the kernel, and end the receive thread. Deadmen keep running."""
        self._library.carrier_stop_receiving(self._address)

    def close(self) -> None:
        with self._in_use:
            address, self._address = self._address, 0
        self._library.carrier_close(address)

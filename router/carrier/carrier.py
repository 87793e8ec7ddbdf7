"""The native threads: receive, and timers."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from threading import Lock

from router import declared as c
from router.carrier.program import NativeProgram
from router.carrier.ring import Ring
from router.errors import StartError


class Carrier:
    """Receives datagrams and executes programs, in native threads that never wait for Python.

    `counters` is the array of the receive thread, which writes losses and rejections to `events`, and what topics get
    to `published`. Deadmen are served when they are due.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        deadmen: int,
        counters: ctypes.Array[ctypes.c_int64],
        events: Ring,
        published: Ring,
    ) -> None:
        """Raises MemoryError."""
        self._library = library
        self._counters, self._keep = counters, (events, published)
        self._in_use = Lock()  # for those who may call while the carrier is closed
        self._carrier: int = library.carrier_open(deadmen, counters, events.address, published.address)
        self._running: tuple[object, ...] = ()
        if not self._carrier:
            raise MemoryError("the carrier cannot be opened")

    @property
    def turns(self) -> int:
        """A number that grows at least every 50 ms unless the receive thread is stuck."""
        with self._in_use:
            return int(self._library.carrier_turns(self._carrier)) if self._carrier else 0

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two datagrams."""
        copy = (ctypes.c_int64 * count)()
        with self._in_use:
            if not self._carrier:
                return list(self._counters[:count])
            self._library.carrier_counters(self._carrier, copy, count)
        return list(copy)

    def start(self, program: NativeProgram, timers: c.TimerChange) -> None:
        """Start the threads, with the timers of the program. Raises StartError."""
        change = c.Change(program=ctypes.pointer(program.structure), timers=timers)
        if error := self._library.carrier_start(self._carrier, ctypes.byref(change)):
            raise StartError(f"the carrier's threads cannot be started: {os.strerror(error)}")
        self._running = program, change

    def change(self, program: NativeProgram, replaced: Sequence[tuple[int, int]], timers: c.TimerChange) -> None:
        """Execute another program from the next datagram on. Listeners that it does not have are emptied before.

        `replaced` has deadmen with those that they take over from; `timers` says what other timers are to do.
        """
        pairs = [deadman for pair in replaced for deadman in pair]
        change = c.Change(
            program=ctypes.pointer(program.structure),
            replaced=(ctypes.c_void_p * len(pairs))(*pairs),
            timers=timers,
            replaced_count=len(replaced),
        )
        self._library.carrier_change(self._carrier, ctypes.byref(change))
        self._running = program, change

    def mirror(self, ring: Ring | None, lost: int) -> None:
        """Write what is received to `ring` from now on. `lost` is the counter of what had no room there.

        After `close`, nothing is received.
        """
        with self._in_use:
            if not self._carrier:
                return
            self._library.carrier_mirror(self._carrier, ring.address if ring else None, lost)

    def watchdog(self, notify: int, interval: int) -> None:
        """Feed a watchdog by a connected socket every `interval` ns, while receiving makes progress and `pulse` is
        called every few seconds."""
        self._library.carrier_watchdog(self._carrier, notify, interval)

    def pulse(self) -> None:
        self._library.carrier_pulse(self._carrier)

    def stop_receiving(self) -> None:
        """Handle what the kernel holds, and end the receive thread. Brakes go on."""
        self._library.carrier_stop_receiving(self._carrier)

    def close(self) -> None:
        with self._in_use:
            carrier, self._carrier = self._carrier, 0
        self._library.carrier_close(carrier)

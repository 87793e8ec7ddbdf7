"""Deadmen of gateway clients. They have a native thread of their own, because they publish, which may block."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable, Mapping
from time import monotonic, sleep

from router.carrier.deadmen import NativeDeadman, replaced
from router.carrier.ring import Ring
from router.carrier.threads import NativeThread
from router.clock import monotonic_ns
from router.errors import StartError
from router.image.names import Names
from router.log import logger

_POLL_S = 0.002

RECEIPT_S = 0.5
"""How long, in seconds, a reload or the stop waits until subscriptions have received the last messages of deadmen."""


class ClientDeadmen(NativeThread):
    """All deadmen of gateway clients, and their thread; never closed. They report to `events`."""

    def __init__(self, library: ctypes.CDLL, counts: ctypes.Array[ctypes.c_int64], events: Ring, names: Names) -> None:
        """Raises MemoryError."""
        super().__init__(library, counts, events)
        self.name = "client deadmen"
        self._names = names
        self._address = int(library.client_deadmen_open(counts, events.address) or 0)
        if not self._address:
            raise MemoryError("the deadmen of gateways cannot be opened")
        self.group: int = library.client_deadmen_group(self._address)
        """The address of their `struct timers`."""
        self._has_started = False

    def start(self, functions: tuple[int, int, int]) -> None:
        """Start the thread if it is not running. `functions` are the addresses in `ros.rcl.PublishFunctions`.

        Raises StartError.
        """
        if not self._has_started:
            error = self._library.client_deadmen_start(self._address, *functions)
            if error:
                raise StartError(f"the thread for deadmen of clients cannot be started: {os.strerror(error)}")
            self._has_started = True

    def adopt(self, before: Mapping[str, NativeDeadman], now: Mapping[str, NativeDeadman], generation: int) -> None:
        """Replace the deadmen of one program with those of the next, which has this generation. Both are by name.

        A deadman with changed settings inherits the state of the earlier one. Those without a successor publish a last
        time if they are armed; wait, but not long, until subscriptions have received that.
        """
        ended = [before[name] for name in before.keys() - now.keys()]
        for deadman in ended:
            deadman.end_by_thread()
        for each, earlier in replaced(now, before, {name: name for name in now}):
            self._library.deadman_replace(self.group, each.address, earlier.address)
        self._library.client_deadmen_advance(self._address, generation)
        if ended and self.wait_for(generation, RECEIPT_S):
            await_receipt(ended)

    def wait_for(self, generation: int, timeout: float) -> bool:
        """Wait until no publisher of earlier generations is in use. Return False after `timeout` s."""
        for _ in range(int(timeout / _POLL_S)):
            if not self._has_started or self._library.client_deadmen_have_reached(self._address, generation):
                return True
            sleep(_POLL_S)
        return False

    def stalled(self) -> tuple[str, float] | None:
        """Return the topic on which the thread is publishing now, and for how many seconds; None if there is none."""
        topic = ctypes.c_uint32()
        since = self._library.client_deadmen_since(self._address, ctypes.byref(topic))
        return (self._names.name(topic.value), (monotonic_ns() - since) / 1e9) if since else None

    def stop(self) -> bool:
        """Have armed deadmen publish a last time, and end the thread.

        Return False if it is stuck in the middleware after 1 s: then it keeps running, and publishers must stay open.
        Idempotent.
        """
        return bool(self._library.client_deadmen_stop(self._address))


def await_receipt(deadmen: Iterable[NativeDeadman]) -> None:
    """Wait until subscriptions have received what these deadmen have published; log which ones have not in time."""
    until = monotonic() + RECEIPT_S
    outlets = [each for deadman in deadmen for each in zip(deadman.endpoints, deadman.outlets, strict=True)]
    late = [topic for topic, each in dict(outlets).items() if not each.await_receipt(max(until - monotonic(), 0.0))]
    if late:
        event = "subscribers may lack the last message of a deadman: they have not acknowledged it in time; continuing"
        logger.warning(event, topics=late, seconds=RECEIPT_S)

"""`collect` as the carrier executes it: `native/collect.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from router import declared as c
from router.carrier.lowered import Routines
from router.compiler.lowering import LoweredCollect


class NativeCollector:
    """Keeps the frames of one route, which end `timeout` ns after their first datagram. `address` is its own."""

    def __init__(self, library: ctypes.CDLL, timeout: int) -> None:
        """Raises MemoryError."""
        self._library = library
        self.address: int = library.collector_open(timeout)
        if not self.address:
            raise MemoryError("frames of messages cannot be collected")

    def __del__(self) -> None:
        self._library.collector_close(self.address)


def native_collect(lowered: LoweredCollect, routines: Routines, senders: Sequence[int]) -> c.Collect:
    """Without a collector. `senders` are numbers of names, by column. The routines are those of the route."""
    numbers = (ctypes.c_uint32 * len(senders))(*senders)
    routines.arrays.append(numbers)
    return c.Collect(
        by=routines.routine(lowered.by),
        count=routines.routine(lowered.count),
        order=routines.routine(lowered.order),
        senders=numbers,
        is_text=lowered.is_text,
        signs=lowered.signs,
        items=lowered.items,
        counted=lowered.counted,
    )

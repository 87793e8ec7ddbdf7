"""`collect` as the carrier executes it: `native/collect.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from router import declared as c
from router.carrier.lowered import Routines
from router.carrier.state import State
from router.compiler.lowering import LoweredCollect
from router.compiler.program import RoutePlan


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


def kept_collector(library: ctypes.CDLL, state: State, plan: RoutePlan) -> NativeCollector:
    """The collector of a route, which lives as long as programs have it, with these topics and this payload."""
    timeout, targets = plan.collect_timeout, tuple(target for target in plan.targets if target.is_topic)
    assert timeout is not None  # noqa: S101 - asked for by the caller
    key = "collect", plan.route, timeout, plan.case.message_class, targets
    return state.keep(key, lambda: NativeCollector(library, timeout))


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

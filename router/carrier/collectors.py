"""`collect` as the carrier executes it: `native/collect.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from router import declared as c
from router.compiler.lowering import LoweredCollect
from router.compiler.lowering.routines import Routines


def native_collect(lowered: LoweredCollect, routines: Routines, senders: Sequence[int]) -> c.Collect:
    """Make the structure, without a collector. `senders` are numbers of names by column, `routines` the route's."""
    numbers = routines.arrays.array(ctypes.c_uint32, senders)
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

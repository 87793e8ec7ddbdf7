"""Stand-alone conditions on payloads, evaluated like `when` of a route."""

from __future__ import annotations

import ctypes

from router.compiler.lowering import LoweredCondition
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.routines import Routines, native_values
from router.declared import DROP_REASONS, EVALUATED


class NativeCondition:
    """A condition on the payloads of one case."""

    def __init__(self, library: ctypes.CDLL, lowered: LoweredCondition) -> None:
        self._arrays = Arrays()
        routines = Routines(lowered.layout, self._arrays)
        self._routine = routines.routine(lowered.routine)
        self._layout = routines.layout()
        self._holds = library.condition_holds

    def holds(self, payload: bytes, source: str, received_at: int) -> bool | None:
        """Return whether the condition holds for a payload from `source`; None if it has no value.

        `received_at` is wall-clock time in ns. Raises MemoryError.
        """
        named = Arrays()
        sender, holds = native_values([source.encode()], named), ctypes.c_bool()
        routine, size = ctypes.byref(self._routine), len(payload)
        outcome = self._holds(self._layout, routine, sender, received_at, payload, size, ctypes.byref(holds))
        if outcome == DROP_REASONS:
            raise MemoryError("a condition cannot be evaluated")
        return holds.value if outcome == EVALUATED else None

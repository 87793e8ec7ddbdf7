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

    def holds(self, payload: bytes, beside: bytes, source: str, received_at: int) -> bool | None:
        """Return whether the condition holds for a payload from `source`; None if it has no value.

        `beside` is the envelope without the payload, `received_at` wall-clock time in ns. Raises MemoryError.
        """
        holds = ctypes.c_bool()
        given = map(ctypes.byref, native_values([source.encode(), payload, beside], named := Arrays()))
        outcome = self._holds(self._layout, ctypes.byref(self._routine), received_at, *given, ctypes.byref(holds))
        del named  # until here it has kept the values
        if outcome == DROP_REASONS:
            raise MemoryError("a condition cannot be evaluated")
        return holds.value if outcome == EVALUATED else None

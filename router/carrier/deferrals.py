"""What holds messages back between two messages and two programs: deferrals of targets, and pacers of endpoints."""

from __future__ import annotations

import ctypes
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from router import declared as c
from router.carrier.limits import period
from router.compiler.program import TargetPlan
from router.table.model import OnLimit


class NativePacer:
    """The pacer of an endpoint with a bandwidth, in bytes per second. `address` is that of its `struct pacer`."""

    def __init__(self, library: ctypes.CDLL, bandwidth: int) -> None:
        """Raises MemoryError."""
        self._library = library
        self.address: int = library.pacer_open(bandwidth) or 0
        if not self.address:
            raise MemoryError("a queue of the carrier cannot be opened")

    def __del__(self) -> None:
        if self.address:
            self._library.pacer_close(self.address)


class NativeDeferral:
    """What may hold back the messages of one target. `address` is that of its `struct deferral`."""

    def __init__(self, library: ctypes.CDLL, pacer: NativePacer | None) -> None:
        """Raises MemoryError."""
        self._library = library
        self._keep = pacer
        self.address: int = library.deferral_open(pacer.address if pacer else None) or 0
        if not self.address:
            raise MemoryError("a deferral of the carrier cannot be opened")

    def __del__(self) -> None:
        if self.address:
            self._library.deferral_close(self.address)


@dataclass(frozen=True, slots=True)
class Adoption:
    """A timer, and what it delivers to from now on: `struct adoption` in native/timers.h."""

    timer: int
    is_topic: bool = False
    targets: int | None = None
    target: int | None = None


def timer_change(
    now: Collection[Adoption], before: Iterable[Adoption] = (), ended: Iterable[int] = ()
) -> c.TimerChange:
    """What a reload does to timers. Those that only the earlier program had end, then others that are `ended`.

    A pacer goes before its deferrals, and deadmen last.
    """
    adopted = [
        c.Adoption(timer=_at(c.Timer, each.timer), to=_at(c.Targets, each.targets), target=_at(c.Target, each.target))
        for each in now
    ]
    kept = {each.timer for each in now}
    left = [*(each.timer for each in before if each.timer not in kept), *ended]
    return c.TimerChange(
        adopted=(c.Adoption * len(adopted))(*adopted),
        ended=(ctypes.c_void_p * len(left))(*left),
        adopted_count=len(adopted),
        ended_count=len(left),
    )


def _at(kind: type[ctypes.Structure], address: int | None) -> ctypes._Pointer[ctypes.Structure] | None:
    return ctypes.pointer(kind.from_address(address)) if address else None


def held_period(target: TargetPlan) -> int:
    """The time between two messages of a target with `on_limit: latest`, in ns; 0 without."""
    return period(target.max_rate) if target.max_rate is not None and target.on_limit is OnLimit.LATEST else 0

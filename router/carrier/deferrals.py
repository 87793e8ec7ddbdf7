"""Deferrals of targets and pacers of endpoints, which hold messages back, also across a reload."""

from __future__ import annotations

import ctypes

from router import declared as c

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Collection, Iterable


class Adoption:
    """A timer and its new target: `struct adoption` in native/timers.h."""

    def __init__(
        self, timer: int, is_topic: bool = False, targets: int | None = None, target: int | None = None
    ) -> None:
        self.timer, self.is_topic, self.targets, self.target = timer, is_topic, targets, target


def timer_change(
    now: Collection[Adoption], before: Iterable[Adoption] = (), ended: Iterable[int] = ()
) -> c.TimerChange:
    """Return the changes of timers at a reload.

    Timers that only the earlier program had end first, then those in `ended`. A pacer ends before its deferrals, and
    deadmen end last.
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

"""What holds messages back between two messages and two programs: deferrals of targets, and pacers of endpoints."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from router import declared as c
from router.carrier.limits import period
from router.carrier.state import State
from router.compiler.program import RoutePlan, TargetPlan
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

    def __init__(self, library: ctypes.CDLL, pacer: NativePacer | None, *, is_topic: bool) -> None:
        """Raises MemoryError."""
        self.is_topic = is_topic
        self._library = library
        self._keep = pacer
        self.address: int = library.deferral_open(pacer.address if pacer else None) or 0
        if not self.address:
            raise MemoryError("a deferral of the carrier cannot be opened")

    def __del__(self) -> None:
        if self.address:
            self._library.deferral_close(self.address)


@dataclass(frozen=True, slots=True)
class Deferrals:
    """Pacers and deferrals of one program. It shares those that have the same key with the previous one, by `state`.

    `senders` are by endpoint, as are `bandwidths`, and `publications` by topic: what waits for one of them does not go
    to another.
    """

    library: ctypes.CDLL
    state: State
    senders: Mapping[str, object]
    publications: Mapping[str, object]
    bandwidths: Mapping[str, int]

    def pacers(self) -> list[NativePacer]:
        """Those of all endpoints with a bandwidth."""
        return [self._pacer(endpoint) for endpoint in self.bandwidths]

    def _pacer(self, endpoint: str) -> NativePacer:
        bandwidth = self.bandwidths[endpoint]
        key = "pacer", endpoint, bandwidth, self.senders[endpoint]
        return self.state.keep(key, lambda: NativePacer(self.library, bandwidth))

    def deferral(self, plan: RoutePlan, target: TargetPlan) -> NativeDeferral | None:
        """The deferral of a target, if it needs one."""
        is_paced = not target.is_topic and target.label in self.bandwidths
        pacer = self._pacer(target.label) if is_paced else None
        if pacer is None and not held_period(target):
            return None
        destination = pacer or (self.publications if target.is_topic else self.senders)[target.label]
        key = "deferral", plan.route, plan.topic, target.label, destination
        return self.state.keep(key, lambda: NativeDeferral(self.library, pacer, is_topic=target.is_topic))


@dataclass(frozen=True, slots=True)
class Adoption:
    """A timer, and what it delivers to from now on: `struct adoption` in native/timers.h."""

    timer: int
    is_topic: bool = False
    targets: int | None = None
    target: int | None = None


def timer_change(adopted: Sequence[Adoption], ended: Sequence[int]) -> c.TimerChange:
    """What a reload does to timers. What ends goes first: a pacer before its deferrals, and deadmen last."""
    adoptions = [
        c.Adoption(timer=_at(c.Timer, each.timer), to=_at(c.Targets, each.targets), target=_at(c.Target, each.target))
        for each in adopted
    ]
    return c.TimerChange(
        adopted=(c.Adoption * len(adoptions))(*adoptions),
        ended=(ctypes.c_void_p * len(ended))(*ended),
        adopted_count=len(adoptions),
        ended_count=len(ended),
    )


def _at(kind: type[ctypes.Structure], address: int | None) -> ctypes._Pointer[ctypes.Structure] | None:
    return ctypes.pointer(kind.from_address(address)) if address else None


def held_period(target: TargetPlan) -> int:
    """The time between two messages of a target with `on_limit: latest`, in ns; 0 without."""
    return period(target.max_rate) if target.max_rate is not None and target.on_limit is OnLimit.LATEST else 0

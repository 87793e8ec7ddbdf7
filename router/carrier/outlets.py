"""What is open for a program, as the carrier's arrays refer to it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from router import declared as c
from router.carrier.boards import NativeBoards
from router.carrier.collectors import NativeCollector
from router.carrier.deferrals import NativeDeferral
from router.compiler.program import RoutePlan, TargetPlan
from router.net.udp import Listener


class Names:
    """Numbers for names, in both directions. A name keeps its number as long as the process lives."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._names: list[str] = []

    def number(self, name: str) -> int:
        if name not in self._numbers:
            self._numbers[name] = len(self._names)
            self._names.append(name)
        return self._numbers[name]

    def name(self, number: int) -> str:
        return self._names[number]


class Publication(Protocol):
    """What `ros.endpoints.Publication` is. Several threads may publish at a time, until it is closed."""

    @property
    def address(self) -> int: ...

    @property
    def wanted(self) -> ctypes.Array[Any]: ...


@dataclass(frozen=True, slots=True)
class Outlets:
    """What is open for a program. Pointers are addresses of C structures.

    `senders` are by endpoint, `publications` by topic. `feeds(route, names)` returns the deadmen that a command feeds
    (False) or disarms (True), `limit(plan, target)` the limit of a target with `max_rate`, `deferral(plan,
    target)` what may hold its messages back, `collector(plan)` what makes frames for its topics. Without `boards`,
    endpoints that are boards get everything.
    """

    listeners: Mapping[str, Listener]
    senders: Mapping[str, int]
    publications: Mapping[str, Publication]
    feeds: Callable[[str, Sequence[str]], Sequence[tuple[int, bool]]]
    limit: Callable[[RoutePlan, TargetPlan], c.Limit]
    deferral: Callable[[RoutePlan, TargetPlan], NativeDeferral | None]
    collector: Callable[[RoutePlan], NativeCollector]
    names: Names
    boards: NativeBoards | None = None

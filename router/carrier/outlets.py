"""What is open for a program, and what its targets keep from one message to the next, for the carrier's arrays."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from router import declared as c
from router.carrier.boards import NativeBoards
from router.carrier.collectors import NativeCollector
from router.carrier.deferrals import Adoption, NativeDeferral, NativePacer
from router.carrier.limits import open_limit
from router.carrier.state import State
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


class Addressed(Protocol):
    """What has a structure in C, at `address`: senders and deadmen."""

    @property
    def address(self) -> int: ...


class Publication(Addressed, Protocol):
    """What `ros.endpoints.Publication` is. Several threads may publish at a time, until it is closed."""

    @property
    def wanted(self) -> ctypes.Array[Any]: ...


@dataclass(frozen=True, slots=True)
class Outlets:
    """What is open for a program. `state` has what its targets keep: the next program takes over what has the same key.

    `senders` and `bandwidths` are by endpoint, `publications` by topic, `deadmen` by route. Without `boards`, endpoints
    that are boards get everything.
    """

    library: ctypes.CDLL
    state: State
    names: Names
    listeners: Mapping[str, Listener]
    senders: Mapping[str, Addressed]
    publications: Mapping[str, Publication]
    deadmen: Mapping[str, Addressed]
    bandwidths: Mapping[str, int]
    boards: NativeBoards | None = None

    def feeds(self, plan: RoutePlan, target: TargetPlan) -> list[c.Feed]:
        """The deadmen that commands of the route feed, which is its own, or disarm."""
        return [c.Feed(deadman=self.deadmen[name].address, disarms=name != plan.route) for name in target.deadmen]

    def limit(self, plan: RoutePlan, target: TargetPlan, source: str | None) -> c.Limit:
        """The limit of a target with `max_rate` for one source of its route."""
        rate = target.max_rate
        assert rate is not None  # noqa: S101 - said by the caller
        return self.state.keep(("limit", plan.route, plan.topic, source, target), lambda: open_limit(rate))

    def pacers(self) -> list[Adoption]:
        """The pacers of all endpoints with a bandwidth."""
        return [Adoption(self._pacer(endpoint).address) for endpoint in self.bandwidths]

    def _pacer(self, endpoint: str) -> NativePacer:
        bandwidth = self.bandwidths[endpoint]
        key = "pacer", endpoint, bandwidth, self.senders[endpoint]
        return self.state.keep(key, lambda: NativePacer(self.library, bandwidth))

    def deferral(self, plan: RoutePlan, target: TargetPlan, source: str | None) -> NativeDeferral:
        """What holds back the messages of one source for a target. They do not go to another sender or publisher."""
        pacer = self._pacer(target.label) if not target.is_topic and target.label in self.bandwidths else None
        destination = pacer or (self.publications if target.is_topic else self.senders)[target.label]
        key = "deferral", plan.route, plan.topic, source, target.label, destination
        return self.state.keep(key, lambda: NativeDeferral(self.library, pacer))

    def collector(self, plan: RoutePlan) -> NativeCollector:
        """What makes frames of the route's payload for its topics."""
        timeout, targets = plan.collect_timeout, tuple(target for target in plan.targets if target.is_topic)
        assert timeout is not None  # noqa: S101 - said by the caller
        key = "collect", plan.route, timeout, plan.case.message_class, targets
        return self.state.keep(key, lambda: NativeCollector(self.library, timeout))

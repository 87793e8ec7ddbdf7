"""The open sockets and topics of a program, and the state of its targets, for the carrier's arrays."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from router import declared as c
from router.carrier.boards import NativeBoards
from router.carrier.deadmen import DeadmanGroup, NativeDeadman, feed_of
from router.carrier.deferrals import Adoption
from router.carrier.limits import period
from router.carrier.names import Names
from router.carrier.state import Native, State
from router.compiler.program import Program, RoutePlan, TargetPlan
from router.net.udp import Listener


class Addressed(Protocol):
    """An object with a C structure at `address`: a sender or deadman. Compared by identity."""

    def __hash__(self) -> int: ...

    @property
    def address(self) -> int: ...


class Publication(Addressed, Protocol):
    """The protocol of `ros.endpoints.Publication`. Several threads may publish at once, until it is closed."""

    @property
    def wanted(self) -> ctypes.Array[Any]: ...


class AwaitedPublication(Publication, Protocol):
    """A publication that can wait until its subscriptions have received everything."""

    def await_receipt(self, timeout: float) -> bool: ...


@dataclass(frozen=True, slots=True)
class Outlets:
    """The open sockets and topics of a program. `state` is that of its targets, passed on by key at a reload.

    `senders` and `bandwidths` are by endpoint, `publications` by topic, `deadmen` by route. Without `boards`, no limits
    of boards are checked.
    """

    program: Program
    library: ctypes.CDLL
    state: State
    names: Names
    listeners: Mapping[str, Listener]
    senders: Mapping[str, Addressed]
    publications: Mapping[str, Publication]
    deadmen: Mapping[str, NativeDeadman]
    bandwidths: Mapping[str, int]
    boards: NativeBoards | None = None

    @classmethod
    def of(
        cls,
        program: Program,
        group: DeadmanGroup,
        state: State,
        *,
        listeners: Mapping[str, Listener],
        senders: Mapping[str, Addressed],
        publications: Mapping[str, Publication],
        boards: NativeBoards | None,
    ) -> Outlets:
        """Return the outlets of a program, with its deadmen in `group`. Raises MemoryError."""
        return cls(
            program=program,
            library=group.library,
            state=state,
            names=group.names,
            listeners=listeners,
            senders=senders,
            publications=publications,
            deadmen={plan.route: group.get_or_open(plan, program.counters, senders, state) for plan in program.deadmen},
            bandwidths={each.name: each.bandwidth for each in program.senders if each.bandwidth is not None},
            boards=boards,
        )

    def feed(self, route: str, endpoint: str, *, disarms: bool) -> c.Feed:
        """Return the effect of commands to an endpoint on the deadman of a route."""
        (plan,) = (each for each in self.program.deadmen if each.route == route)
        return feed_of(plan, self.deadmen[route], endpoint, disarms=disarms)

    def holding(self, route: str, endpoint: str) -> list[Native]:
        """Return the deferrals that hold commands of a route to an endpoint."""
        return [
            self.deferral(plan, target, source)
            for plan in self.program.routes
            if plan.route == route
            for target in plan.targets
            if target.label == endpoint and target.is_deferred and not target.is_topic
            for source in ([None] if plan.topic is not None else sorted(plan.sources, key=str))
        ]

    def limit(self, plan: RoutePlan, target: TargetPlan, source: str | None) -> Native:
        """Return the limit of a target with `max_rate` for one source of its route."""
        rate = target.max_rate
        assert rate is not None  # noqa: S101 - checked by the caller
        place = "limit", plan.route, plan.topic, source, target.label
        return self.state.get_or_open(place, target, self._native("limit"), "limit_open", period(rate))

    def pacers(self) -> list[Adoption]:
        """Return the pacers of all endpoints with a bandwidth."""
        return [Adoption(self._pacer(endpoint).address) for endpoint in self.bandwidths]

    def _pacer(self, endpoint: str) -> Native:
        place, bandwidth = ("pacer", endpoint), self.bandwidths[endpoint]
        rest = bandwidth, self.senders[endpoint]
        return self.state.get_or_open(place, rest, self._native("pacer"), "pacer_open", bandwidth)

    def _native(self, kind: str, keep: object = None) -> Callable[[int], Native]:
        """Return a function that wraps the address of an opened structure."""
        return lambda address: Native(getattr(self.library, f"{kind}_close"), address, keep)

    def deferral(self, plan: RoutePlan, target: TargetPlan, source: str | None) -> Native:
        """Return the deferral that holds back messages of a source for a target, as long as the outlet is the same."""
        pacer = self._pacer(target.label) if not target.is_topic and target.label in self.bandwidths else None
        destination = pacer or (self.publications if target.is_topic else self.senders)[target.label]
        place = "deferral", plan.route, plan.topic, source, target.label
        address = pacer.address if pacer else None
        return self.state.get_or_open(place, destination, self._native("deferral", pacer), "deferral_open", address)

    def collector(self, plan: RoutePlan) -> Native:
        """Return the collector that makes frames of the route's payload for its topics."""
        timeout, targets = plan.collect_timeout, tuple(target for target in plan.targets if target.is_topic)
        assert timeout is not None  # noqa: S101 - checked by the caller
        rest = timeout, plan.case.message_class, targets
        return self.state.get_or_open(
            ("collect", plan.route), rest, self._native("collector"), "collector_open", timeout
        )

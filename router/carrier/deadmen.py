"""Deadmen of the carrier: native code sends commands and deadman payloads under one lock."""

from __future__ import annotations

import ctypes

from router import declared as c
from router.carrier.threads import NativeThread

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping
    from typing import TypeVar

    from router.carrier.names import Names
    from router.carrier.outlets import Addressed
    from router.carrier.ring import Ring
    from router.carrier.state import State
    from router.compiler.metrics import Counters
    from router.compiler.program import DeadmanPlan

    Deadman = TypeVar("Deadman", bound="NativeDeadman")


class NativeDeadman:
    """The deadman of one route, which sends to `endpoints`. `address` is that of its `struct deadman`."""

    def __init__(
        self, library: ctypes.CDLL, deadmen: int, address: int, endpoints: Iterable[str], keep: object = None
    ) -> None:
        self.address = address
        self._library = library
        self._deadmen = deadmen
        self._endpoints = endpoints
        self._keep = keep
        self._successor: NativeDeadman | None = None

    def start(self, now: int) -> list[str]:
        """Send the payload at router start, unless the table says otherwise. Return the endpoints reached."""
        reached = self._library.deadman_start(self._deadmen, self.address, now)
        return [endpoint for bit, endpoint in enumerate(self._endpoints) if reached >> bit & 1]

    def replace(self, earlier: NativeDeadman) -> None:
        """Live as long as `earlier`: once the carrier has replaced that, feeding it feeds this deadman."""
        earlier._successor = self

    def end(self) -> None:
        """Send a last time if armed or tripped."""
        self._library.timer_end(self._deadmen, self.address)

    def __del__(self) -> None:
        self._library.deadman_close(self._deadmen, self.address)


class DeadmanGroup:
    """Deadmen of routes, served by one thread. `address` is that of their `struct timers`."""

    def __init__(self, library: ctypes.CDLL, address: int, names: Names) -> None:
        self.library = library
        self.names = names
        self.address = address

    def get_or_open(
        self, plan: DeadmanPlan, counters: Counters, senders: Mapping[str, Addressed], state: State
    ) -> NativeDeadman:
        """Return the deadman of a route. Programs with the same plan and senders share it. Raises MemoryError."""
        endpoints = [endpoint for endpoint, _ in plan.datagrams]
        used = [senders[endpoint] for endpoint in endpoints]
        return state.get_or_open(
            ("deadman", plan.route),
            (plan, *used),
            lambda address: NativeDeadman(self.library, self.address, address, endpoints, used),
            "deadman_open",
            self.address,
            *settings(plan, counters, self.names),
            *destinations_of(plan, counters, self.names, used),
        )


class Deadmen(NativeThread, DeadmanGroup):
    """All deadmen of routes; never closed. They report to `events`."""

    def __init__(self, library: ctypes.CDLL, counts: ctypes.Array[ctypes.c_int64], events: Ring, names: Names) -> None:
        """Raises MemoryError."""
        NativeThread.__init__(self, library, counts, events)
        DeadmanGroup.__init__(self, library, library.timers_open(counts, events.address) or 0, names)
        if not self.address:
            raise MemoryError("the deadmen of the carrier cannot be opened")

    def end(self) -> None:
        """Send what is held back, then have deadmen send a last time. Nothing is held back afterwards."""
        self.library.timers_end(self.address)


def successors(now: Collection[DeadmanPlan], before: Iterable[DeadmanPlan]) -> dict[str, str]:
    """Return the routes whose deadmen replace those of an earlier program, by the earlier route.

    A deadman replaces the one that watched the same commands, because the name of a route depends on the other routes
    of its case. If there is none, it replaces the one of the same name.
    """
    routes: dict[str, str] = {}
    others: list[str] = []
    for earlier in before:
        best = max(now, key=lambda plan: len(plan.watched & earlier.watched), default=None)
        if best is not None and best.watched & earlier.watched:
            routes[earlier.route] = best.route
        else:
            others.append(earlier.route)
    free = {plan.route for plan in now} - {*routes.values()}
    return {**routes, **{route: route for route in others if route in free}}


def replaced(
    now: Mapping[str, Deadman], before: Mapping[str, Deadman], routes: Mapping[str, str]
) -> list[tuple[Deadman, Deadman]]:
    """Return pairs of a deadman and the earlier one that it replaces; `routes` are as `successors` returns them.

    The deadman now lives as long as the earlier one.
    """
    kept = [*now.values()]
    pairs = [(now[routes[name]], each) for name, each in before.items() if name in routes and each not in kept]
    for each, earlier in pairs:
        each.replace(earlier)
    return pairs


def settings(plan: DeadmanPlan, counters: Counters, names: Names) -> tuple[int, int, bool, int, int, int]:
    """Return the arguments of `deadman_open` between the group and the destinations."""
    active, trips = counters.index("deadman_active", plan.route), counters.index("deadman_trips", plan.route)
    return plan.timeout, plan.repeat, plan.at_start, active, trips, names.number(plan.route)


def destinations_of(
    plan: DeadmanPlan, counters: Counters, names: Names, outlets: Iterable[Addressed], kind: str = "sender"
) -> tuple[ctypes.Array[c.DeadmanDestination], int]:
    """Return the payloads of a deadman for its senders or publishers (`kind`), as arguments of `deadman_open`."""
    made = [
        c.DeadmanDestination(
            datagrams=datagrams_of(datagrams),
            count=len(datagrams),
            sent=counters.index("deadman_datagrams_sent", plan.route, name),
            send_errors=counters.index("deadman_send_errors", plan.route, name),
            id=names.number(name),
            follows=name in plan.following,
            **{kind: outlet.address},
            **(_heard(name, counters) if kind == "sender" else {}),
            **_obeyed(plan, name, counters),
        )
        for (name, datagrams), outlet in zip(plan.datagrams, outlets, strict=True)
    ]
    return (c.DeadmanDestination * len(made))(*made), len(made)


def feed_of(plan: DeadmanPlan, deadman: Addressed, endpoint: str, *, disarms: bool) -> c.Feed:
    """Return the effect on a deadman of each command to an endpoint.

    A command to an endpoint that the deadman does not send to arms all that it sends to.
    """
    endpoints = [name for name, _ in plan.datagrams]
    armed = [endpoint] if endpoint in endpoints else endpoints
    return c.Feed(deadman=deadman.address, to=sum(1 << endpoints.index(each) for each in armed), disarms=disarms)


def datagrams_of(datagrams: Collection[bytes]) -> ctypes.Array[c.DeadmanDatagram]:
    """Return the datagrams for one destination."""
    return (c.DeadmanDatagram * len(datagrams))(*(c.DeadmanDatagram(data=each, size=len(each)) for each in datagrams))


def _heard(name: str, counters: Counters) -> Mapping[str, int]:
    """Return the fields of a destination that say when it was last heard."""
    return {"is_heard": 1, "last_seen": counters.index("endpoint_silence_seconds", name)}


def _obeyed(plan: DeadmanPlan, name: str, counters: Counters) -> Mapping[str, int]:
    """Return the fields of a destination that say within which time it must obey, and the counters for that."""
    if plan.obeyed is None or name not in plan.obeyed.endpoints:
        return {}
    return {
        "within": plan.obeyed.within,
        "disobeyed": counters.index("deadman_disobeyed", plan.route, name),
        "stopping": counters.index("deadman_stopping_seconds", plan.route, name),
    }

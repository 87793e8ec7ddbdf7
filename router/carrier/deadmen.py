"""Deadmen of the carrier: native code sends commands and brakes under one lock."""

from __future__ import annotations

import ctypes

from router import declared as c
from router.carrier.threads import NativeThread

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
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
        """Send the payload when the router starts, unless the table says otherwise; return the endpoints reached."""
        reached = self._library.deadman_start(self._deadmen, self.address, now)
        return [endpoint for bit, endpoint in enumerate(self._endpoints) if reached >> bit & 1]

    def succeeds(self, earlier: NativeDeadman) -> None:
        """Live as long as `earlier`, whose feeds act on this one once the carrier has replaced it."""
        earlier._successor = self

    def end(self) -> None:
        """Send a last time, if armed or tripped."""
        self._library.timer_end(self._deadmen, self.address)

    def __del__(self) -> None:
        self._library.deadman_close(self._deadmen, self.address)


class DeadmanGroup:
    """Deadmen of routes that one thread serves. `address` is that of its `struct timers`."""

    def __init__(self, library: ctypes.CDLL, address: int, names: Names) -> None:
        self._library = library
        self._names = names
        self.address = address

    def kept(
        self, plan: DeadmanPlan, counters: Counters, senders: Mapping[str, Addressed], state: State
    ) -> NativeDeadman:
        """The deadman of a route, which lives as long as programs have it with these senders. Raises MemoryError."""
        endpoints = [endpoint for endpoint, _ in plan.datagrams]
        used = [senders[endpoint] for endpoint in endpoints]
        return state.open(
            ("deadman", plan.route),
            (plan, *used),
            lambda address: NativeDeadman(self._library, self.address, address, endpoints, used),
            "deadman_open",
            self.address,
            *settings(plan, counters, self._names),
            *destinations_of(plan, counters, self._names, used),
        )


class Deadmen(NativeThread, DeadmanGroup):
    """All deadmen of routes. They write to `events` what they do; never closed."""

    def __init__(self, library: ctypes.CDLL, counts: ctypes.Array[ctypes.c_int64], events: Ring, names: Names) -> None:
        """Raises MemoryError."""
        NativeThread.__init__(self, library, counts, events)
        DeadmanGroup.__init__(self, library, library.timers_open(counts, events.address) or 0, names)
        if not self.address:
            raise MemoryError("the deadmen of the carrier cannot be opened")

    def end(self) -> None:
        """Send what waits, then have deadmen send a last time. Nothing waits afterwards."""
        self._library.timers_end(self.address)


def replaced(now: Mapping[str, Deadman], before: Mapping[str, Deadman]) -> list[tuple[Deadman, Deadman]]:
    """The deadmen of a program that go on from other ones of an earlier program, by route, each with that one."""
    pairs = [(each, before[route]) for route, each in now.items() if before.get(route, each) is not each]
    for each, earlier in pairs:
        each.succeeds(earlier)
    return pairs


def settings(plan: DeadmanPlan, counters: Counters, names: Names) -> tuple[int, int, bool, int, int, int]:
    """What `deadman_open` gets between the group and the destinations."""
    active, trips = counters.index("deadman_active", plan.route), counters.index("deadman_trips", plan.route)
    return plan.timeout, plan.repeat, plan.at_start, active, trips, names.number(plan.route)


def destinations_of(
    plan: DeadmanPlan, counters: Counters, names: Names, outlets: Iterable[Addressed], kind: str = "sender"
) -> tuple[ctypes.Array[c.DeadmanDestination], int]:
    """What a deadman sends to its outlets, senders or publishers (`kind`), as `deadman_open` gets it."""
    made = [
        c.DeadmanDestination(
            datagram=datagram,
            size=len(datagram),
            sent=counters.index("deadman_datagrams_sent", plan.route, name),
            send_errors=counters.index("deadman_send_errors", plan.route, name),
            id=names.number(name),
            **{kind: outlet.address},
        )
        for (name, datagram), outlet in zip(plan.datagrams, outlets, strict=True)
    ]
    return (c.DeadmanDestination * len(made))(*made), len(made)

"""Deadmen of the carrier: native code sends commands and brakes under one lock."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import TypeVar

from router import declared as c
from router.carrier.outlets import Addressed, Names
from router.carrier.ring import Ring
from router.carrier.state import State
from router.carrier.threads import NativeThread
from router.compiler.metrics import Counters
from router.compiler.program import DeadmanPlan


class NativeDeadman:
    """The deadman of one route. `address` is that of its `struct deadman`."""

    def __init__(self, library: ctypes.CDLL, deadmen: int, address: int, plan: DeadmanPlan, keep: object) -> None:
        self.address = address
        self._library = library
        self._deadmen = deadmen
        self._plan = plan
        self._keep = keep
        self._successor: NativeDeadman | None = None

    def start(self, now: int) -> list[str]:
        """Send the payload when the router starts, unless the table says otherwise; return the endpoints reached."""
        reached = self._library.deadman_start(self._deadmen, self.address, now)
        return [endpoint for bit, (endpoint, _) in enumerate(self._plan.datagrams) if reached >> bit & 1]

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
        used = {endpoint: senders[endpoint] for endpoint, _ in plan.datagrams}
        return state.keep(("deadman", plan, tuple(used.values())), lambda: self.add(plan, counters, used))

    def add(self, plan: DeadmanPlan, counters: Counters, senders: Mapping[str, Addressed]) -> NativeDeadman:
        """Serve a deadman from now on. `senders` are by endpoint. Raises MemoryError."""
        outlets = {endpoint: {"sender": senders[endpoint].address} for endpoint, _ in plan.datagrams}
        address = open_deadman(self._library, self.address, self._names, counters, plan, outlets)
        return NativeDeadman(self._library, self.address, address, plan, senders)


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


Deadman = TypeVar("Deadman", bound=NativeDeadman)


def replaced(now: Mapping[str, Deadman], before: Mapping[str, Deadman]) -> list[tuple[Deadman, Deadman]]:
    """The deadmen of a program that go on from other ones of an earlier program, by route, each with that one."""
    pairs = [(each, before[route]) for route, each in now.items() if before.get(route, each) is not each]
    for each, earlier in pairs:
        each.succeeds(earlier)
    return pairs


def open_deadman(
    library: ctypes.CDLL,
    group: int,
    names: Names,
    counters: Counters,
    plan: DeadmanPlan,
    outlets: Mapping[str, Mapping[str, int]],
) -> int:
    """Return the address of a `struct deadman`, which is served from now on. Raises MemoryError.

    `outlets` has the sender or the publisher, as in `struct deadman_destination`, by the name of each destination.
    """
    destinations = [
        c.DeadmanDestination(
            datagram=datagram,
            size=len(datagram),
            sent=counters.index("deadman_datagrams_sent", plan.route, name),
            send_errors=counters.index("deadman_send_errors", plan.route, name),
            id=names.number(name),
            **outlets[name],
        )
        for name, datagram in plan.datagrams
    ]
    address = library.deadman_open(
        group,
        plan.timeout,
        plan.repeat,
        plan.at_start,
        counters.index("deadman_active", plan.route),
        counters.index("deadman_trips", plan.route),
        names.number(plan.route),
        (c.DeadmanDestination * len(destinations))(*destinations),
        len(destinations),
    )
    if not address:
        raise MemoryError("a deadman of the carrier cannot be opened")
    return int(address)

"""Deadmen of the carrier: native code sends commands and deadman payloads under one lock."""

from __future__ import annotations

import ctypes

from router import declared as c
from router.carrier.owned import open_native
from router.carrier.threads import NativeThread

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from typing import Any

    from router.carrier.ring import Ring

    Watching = Sequence[tuple[str, list[str], list[tuple[str, str]]]]
    """The deadmen of an image: `Image.deadmen`."""


class NativeDeadman:
    """The deadman of one route, which sends to `endpoints`. `address` is that of its `struct deadman`.

    One of gateway clients publishes on topics instead. Its group is served by a thread that may block; no call waits
    for that. `keep` is kept alive for it.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        group: int,
        address: int,
        endpoints: Collection[str],
        outlets: Sequence[Any] = (),
        keep: object = None,
    ) -> None:
        self.address = address
        self.endpoints = endpoints
        self.outlets = outlets
        """The senders or publications of the endpoints."""
        self._keep = keep
        self._library = library
        self._group = group
        self._successor: NativeDeadman | None = None

    def start(self, now: int) -> list[str]:
        """Send the payload at router start, unless the table says otherwise. Return the endpoints reached."""
        reached = self._library.deadman_start(self._group, self.address, now)
        return [endpoint for bit, endpoint in enumerate(self.endpoints) if reached >> bit & 1]

    def await_subscribers(self, now: int) -> None:
        """Publish to each subscriber discovered shortly after the start, unless the table says otherwise."""
        self._library.deadman_await_subscribers(self._group, self.address, now)

    def greet(self, now: int) -> bool:
        """Handle a new subscriber. Return whether the deadman publishes to it, because no client has published yet."""
        return bool(self._library.deadman_greet(self._group, self.address, now))

    def feed(self, now: int) -> None:
        """Feed the deadman after a client's message is published; `now` (boot clock, ns) is before the publish call."""
        self._library.deadman_feed(self._group, self.address, now)

    def replace(self, earlier: NativeDeadman) -> None:
        """Live as long as `earlier`: once the carrier has replaced that, feeding it feeds this deadman."""
        earlier._successor = self

    def end(self) -> None:
        """Send a last time if armed or tripped."""
        self._library.timer_end(self._group, self.address)

    def end_by_thread(self) -> None:
        """Likewise, but in the thread that serves the group."""
        self._library.deadman_end_by_thread(self._group, self.address)

    def __del__(self) -> None:
        self._library.deadman_close(self._group, self.address)


class Deadmen(NativeThread):
    """All deadmen of routes; never closed. They report to `events`. `address` is that of their `struct timers`."""

    def __init__(self, library: ctypes.CDLL, counts: ctypes.Array[ctypes.c_int64], events: Ring) -> None:
        """Raises MemoryError."""
        super().__init__(library, counts, events)
        self.address: int = library.timers_open(counts, events.address) or 0
        if not self.address:
            raise MemoryError("the deadmen of the carrier cannot be opened")

    def end(self) -> None:
        """Send what is held back, then have deadmen send a last time. Nothing is held back afterwards."""
        self._library.timers_end(self.address)


def successors(now: Watching, before: Watching) -> dict[str, str]:
    """Return the routes whose deadmen replace those of an earlier image, by the earlier route.

    A deadman replaces the one that watched the same commands, because the name of a route depends on the other routes
    of its case. If there is none, it replaces the one of the same name.
    """
    routes: dict[str, str] = {}
    others: list[str] = []
    watching = {route: {*watched} for route, _, watched in now}
    for earlier, _, watched in before:
        best = max(watching, key=lambda route: len(watching[route].intersection(watched)), default=None)
        if best is not None and not watching[best].isdisjoint(watched):
            routes[earlier] = best
        else:
            others.append(earlier)
    free = watching.keys() - {*routes.values()}
    return {**routes, **{route: route for route in others if route in free}}


def replaced(
    now: Mapping[str, NativeDeadman], before: Mapping[str, NativeDeadman], routes: Mapping[str, str]
) -> list[tuple[NativeDeadman, NativeDeadman]]:
    """Return pairs of a deadman and the earlier one that it replaces; `routes` are as `successors` returns them.

    The deadman now lives as long as the earlier one.
    """
    kept = [*now.values()]
    pairs = [(now[routes[name]], each) for name, each in before.items() if name in routes and each not in kept]
    for each, earlier in pairs:
        each.replace(earlier)
    return pairs


def open_deadman(
    library: ctypes.CDLL,
    arguments: Collection[Any],
    address: Callable[[Any], Any],
    endpoints: Collection[str],
    outlets: Sequence[Any],
    keep: object = None,
) -> NativeDeadman:
    """Open a deadman with the arguments of an opening of an image. Raises MemoryError.

    `address` converts arguments that are symbols. `outlets` are the senders or publications of the endpoints. `keep` is
    kept alive for it.
    """
    group, *others, destinations = arguments
    array = (c.DeadmanDestination * len(destinations))(*(_destination(*each, address=address) for each in destinations))
    timers = address(group)
    opened = open_native(library, "deadman_open", timers, *others, array, len(array))
    return NativeDeadman(library, timers, opened, endpoints, outlets, keep)


def _destination(
    kind: str, outlet: Any, datagrams: Collection[bytes], *others: Any, address: Callable[[Any], Any]
) -> c.DeadmanDestination:
    sent, send_errors, number, follows, is_heard, last_seen, within, disobeyed, stopping, sequence, filled = others
    array = (c.DeadmanDatagram * len(datagrams))(*(c.DeadmanDatagram(data=each, size=len(each)) for each in datagrams))
    fields = (c.BesideField * len(filled))(*(c.BesideField(*each) for each in filled))
    to = c.DeadmanDestination(
        datagrams=array,
        beside=c.Beside(sequence=address(sequence) if filled else None, fields=fields, count=len(fields)),
        count=len(datagrams),
        sent=sent,
        send_errors=send_errors,
        id=number,
        follows=follows,
        is_heard=is_heard,
        last_seen=last_seen,
        within=within,
        disobeyed=disobeyed,
        stopping=stopping,
    )
    setattr(to, kind, address(outlet))
    return to

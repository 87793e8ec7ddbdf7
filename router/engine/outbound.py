"""From the bytes of a ROS message to the handlers of the routes that its topic feeds."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS, HISTOGRAM_CELLS
from router.compiler.program import Handler, Program
from router.engine.binding import Handle, Outlets, bind, unbind
from router.engine.freshness import Freshness

Take = Callable[[bytes, int], None]


@dataclass(frozen=True, slots=True)
class _Route:
    handle: Handle
    is_aged: bool
    last_message: int
    seconds: int


class OutboundEngine:
    """A program's routes from ROS, bound to the outside world."""

    def __init__(self, program: Program, outlets: Outlets) -> None:
        self._program = program
        self._outlets = outlets
        self._handles: list[FunctionType] = []
        self._freshness = outlets.state.keep("freshness of ROS messages", Freshness)

    def forget(self) -> None:
        """Nobody calls the handlers any more."""
        for handle in self._handles:
            unbind(handle)

    def taker(self, topic: str) -> Take:
        """The function that takes one topic's messages: CDR bytes, and when the middleware got them (wall clock, ns).

        It never raises for what was received.
        """
        routes = [self._route(handler) for handler in self._program.outbound[topic]]
        counts, bounds, total = self._outlets.counts, HISTOGRAM_BOUNDS_NS, HISTOGRAM_CELLS - 1
        clock_ns, wall_ns, born = self._outlets.clock_ns, self._outlets.wall_ns, self._freshness.born

        def take(cdr: bytes, arrived_at: int) -> None:
            now = clock_ns()
            received_at = wall_ns()
            for route in routes:
                if route.is_aged:
                    route.handle(cdr, received_at, now, topic, born(arrived_at, received_at, now))
                else:
                    route.handle(cdr, received_at, now, topic)
                counts[route.last_message] = received_at
                elapsed = clock_ns() - now
                counts[route.seconds + bisect_left(bounds, elapsed)] += 1
                counts[route.seconds + total] += elapsed

        return take

    def _route(self, handler: Handler) -> _Route:
        counters = self._program.counters
        self._handles.append(handle := bind(handler, counters, self._outlets, self._freshness))
        return _Route(
            handle=handle,
            is_aged=handler.ttl is not None,
            last_message=counters.index("route_last_message_timestamp_seconds", handler.route),
            seconds=counters.index("route_duration_seconds", handler.route),
        )

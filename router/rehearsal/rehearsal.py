"""A program run on a clock that stands still until it is told to go: what comes in is told, what goes out is a list.

Engines, deadmen, pacers and frames are the router's own, wired as the router wires them; every topic has a subscriber,
and the network takes everything. Knows no socket, no rclpy, no thread, and no test: `router test` and `router replay
--against` are built on it. Gateways have no part in it, nor has what deadmen send when the router starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from router.compiler.metrics import Series
from router.compiler.program import Program
from router.engine import InboundEngine, OutboundEngine
from router.engine.binding import EngineContext, TimerGroup
from router.engine.deadman import Deadman, feeder
from router.engine.delivery import Report
from router.engine.dispatch import Peer
from router.engine.pacing import Pacer
from router.engine.timers import P, R, Timer
from router.rehearsal.events import DeadmanChanged, Dropped, Event, Rejected, event_of, is_told

START = 1_767_225_600_000_000_000
"""Where the clock stands unless it is said: the beginning of 2026, in ns of the wall clock."""


class Rehearsal:
    """One run of a program, from the state of a router that has just started.

    `now` is both clocks, wall and monotonic: nobody sets the clock here. `events` has what happened, in order; it is
    the caller's to clear. The same calls give the same events.
    """

    def __init__(self, program: Program, start_ns: int = START) -> None:
        self.now = start_ns
        self.events: list[Event] = []
        self._program = program
        self._timers: list[Timer] = []
        self._arrived_at: int | None = None
        context = self._context(_Counts(program, self._counted))
        arrived_at = {plan.name: self._arrival for plan in program.listeners}
        inbound = InboundEngine(program, context, arrived_at)
        self._receive = {plan.name: inbound.receiver(plan.name) for plan in program.listeners}
        outbound = OutboundEngine(program, context)
        self._take = {plan.label: outbound.taker(plan.label) for plan in program.subscriptions}
        self._data = b""

    def datagram(self, listener: str, peer: Peer, data: bytes, arrived_ns: int | None = None) -> None:
        """Received now. `arrived_ns`: since when it waited in the socket. Raises KeyError for no listener."""
        self._arrived_at = arrived_ns
        self._receive[listener](data, peer)

    def ros(self, topic: str, cdr: bytes, sent_ns: int | None = None) -> None:
        """A message of a subscription, published at `sent_ns`. Raises KeyError for a topic that has none."""
        self._take[topic](cdr, self.now if sent_ns is None else sent_ns)

    def advance(self, to_ns: int) -> None:
        """Has time pass until `to_ns`, with what is due on the way and then. Time that has passed stays passed."""
        while (due := self._next_due()) is not None and due <= to_ns:
            self.now = max(self.now, due)
            for timer in reversed(self._timers):  # as a TimerThread: the last may hand on to earlier ones
                timer.due(self.now)
        self.now = max(self.now, to_ns)

    def close(self) -> None:
        """The router stops in good order: frames end, what waits is sent, armed deadmen have the last word."""
        last = [timer for timer in self._timers if isinstance(timer, Deadman)]
        for timer in [each for each in reversed(self._timers) if each not in last] + last[::-1]:
            timer.end(self.now)

    def _next_due(self) -> int | None:
        return min((timer.next_due for timer in self._timers if timer.next_due is not None), default=None)

    def _arrival(self) -> int:
        return self.now if self._arrived_at is None else self._arrived_at

    def _context(self, counts: list[int]) -> EngineContext:
        program, send = self._program, {to.name: self._take_datagram for to in self._program.senders}
        deadmen = {
            plan.route: Deadman(plan, program.counters, counts, send, self._explain, self._deadman_changed)
            for plan in program.deadmen
        }
        pacers = {to.name: Pacer(to.budget, send[to.name]) for to in program.senders if to.budget}
        self._timers += pacers.values()  # before what hands on to them
        group = TimerGroup(counts, self._locked)
        return EngineContext(
            counts=counts,
            send=send,
            publish={plan.label: self._take_message for plan in program.publishers},
            wanted={plan.label: [True] for plan in program.publishers},
            report=self._explain,
            clock_ns=lambda: self.now,
            wall_ns=lambda: self.now,
            pacing=group,
            collecting=group,
            feed=feeder(deadmen, self._locked),
            pacers=pacers,
        )

    def _locked(self, timer: Timer, call: Callable[P, R]) -> Callable[P, R]:
        if timer not in self._timers:
            self._timers.append(timer)
        return call

    # what happens

    def _take_datagram(self, data: bytes) -> int:
        self._data = data
        return len(data)

    def _take_message(self, cdr: bytes) -> None:
        self._data = bytes(cdr)

    def _counted(self, series: Series) -> None:
        """The counters tell what became of a message, at which target of which route: outlets know no routes."""
        self.events.append(event_of(series, self.now, self._data))

    def _explain(self, report: Report) -> None:
        """What was counted just now is told in words as well."""
        event = self.events[-1]
        if isinstance(event, (Dropped, Rejected)):
            self.events[-1] = replace(event, detail=report.detail or str(report.error or ""))

    def _deadman_changed(self, route: str, active: bool) -> None:
        self.events.append(DeadmanChanged(self.now, route, active))


class _Counts(list[int]):
    """The counts of a program's counters, which tell of each series that is counted up."""

    def __init__(self, program: Program, counted: Callable[[Series], None]) -> None:
        super().__init__(program.counters.fresh_counts())
        self._series = {index: series for series, index in program.counters.series() if is_told(series)}
        self._counted = counted

    def __setitem__(self, index, value) -> None:  # type: ignore[no-untyped-def]  # it is never a slice
        super().__setitem__(index, value)
        if index in self._series:
            self._counted(self._series[index])

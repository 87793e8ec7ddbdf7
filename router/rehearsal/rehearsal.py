"""A program on a clock that stands still until it is told to go: messages go in, a list of events comes out.

Engines, deadmen, pacers and frames are the router's own, wired as the router wires them. Every topic has a subscriber,
and the network takes everything. Gateways have no part in it, nor has what deadmen send when the router starts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from router.compiler.metrics import Report, Series
from router.compiler.program import Program
from router.datagrams import Peer
from router.engine import InboundEngine, OutboundEngine
from router.engine.binding import EngineContext, TimerGroup
from router.engine.deadman import Deadman, commander
from router.engine.freshness import Freshness
from router.engine.pacing import Pacer
from router.engine.timers import P, R, Timer

START = 1_767_225_600_000_000_000
"""Where the clock stands at first unless another time is given: the beginning of 2026, in ns of the wall clock."""


# Events


@dataclass(frozen=True, slots=True)
class Event:
    """What became of a message at `at`, ns of the rehearsal's clock."""

    at: int


@dataclass(frozen=True, slots=True)
class Received(Event):
    """A route took a message from `source`: an endpoint, `unknown`, or a ROS topic."""

    route: str
    source: str


@dataclass(frozen=True, slots=True)
class Sent(Event):
    """A datagram for an endpoint; `by_deadman` where the route's deadman sent it in place of a command."""

    route: str
    target: str
    data: bytes
    by_deadman: bool = False


@dataclass(frozen=True, slots=True)
class Published(Event):
    """A message for a topic, under the name that the table gives it; `data` are its CDR bytes."""

    route: str
    target: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Dropped(Event):
    """A target did not get a message, for one of metrics.DROP_REASONS; `detail` says more where there is more."""

    route: str
    target: str
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Filtered(Event):
    """`when` held a message back from a target, or a frame had the datagram already."""

    route: str
    target: str


@dataclass(frozen=True, slots=True)
class Collected(Event):
    """A datagram joined an open frame of a target."""

    route: str
    target: str


@dataclass(frozen=True, slots=True)
class Rejected(Event):
    """No route took a datagram, for one of metrics.REJECT_REASONS."""

    listener: str
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class DeadmanChanged(Event):
    """A route's deadman tripped, or was released."""

    route: str
    active: bool


_EVENTS: Mapping[str, Callable[[int, tuple[str, ...], bytes], Event]] = {
    "messages_received": lambda at, labels, _: Received(at, *labels),
    "datagrams_sent": lambda at, labels, data: Sent(at, labels[0], labels[1], data),
    "deadman_datagrams_sent": lambda at, labels, data: Sent(at, labels[0], labels[1], data, by_deadman=True),
    "messages_published": lambda at, labels, data: Published(at, labels[0], labels[1], data),
    "messages_dropped": lambda at, labels, _: Dropped(at, *labels),
    "messages_filtered": lambda at, labels, _: Filtered(at, *labels),
    "messages_collected": lambda at, labels, _: Collected(at, *labels),
    "datagrams_rejected": lambda at, labels, _: Rejected(at, *labels),
}
"""The event for each metric that is one when it is counted: from time, label values, and the bytes handed over last."""


# The run


class Rehearsal:
    """One run of a program, from the state of a router that has just started.

    `now` is both clocks, wall and monotonic, in ns. `events` has what happened, in order; the caller may clear it.
    The same calls give the same events.
    """

    def __init__(self, program: Program, start_ns: int = START) -> None:
        self.now = start_ns
        self.events: list[Event] = []
        self._timers: list[Timer] = []
        self._arrived_at: int | None = None
        self._data = b""
        context = self._context(program)
        inbound = InboundEngine(program, context, {plan.name: self._arrival for plan in program.listeners}, Freshness())
        self._receive = {plan.name: inbound.receiver(plan.name) for plan in program.listeners}
        outbound = OutboundEngine(program, context, Freshness())
        self._take = {plan.label: outbound.taker(plan.label) for plan in program.subscriptions}

    def datagram(self, listener: str, peer: Peer, data: bytes, arrived_ns: int | None = None) -> None:
        """Receive a datagram now, which waited in the socket since `arrived_ns`. Raises KeyError for no listener."""
        self._arrived_at = arrived_ns
        self._receive[listener](data, peer)

    def ros(self, topic: str, cdr: bytes, sent_ns: int | None = None) -> None:
        """Take a message of a subscription, published at `sent_ns`. Raises KeyError for a topic without one."""
        self._take[topic](cdr, self.now if sent_ns is None else sent_ns, False)

    def advance(self, to_ns: int) -> None:
        """Let time pass until `to_ns` and serve the timers that are due by then. Never goes back."""
        while (due := self._next_due()) is not None and due <= to_ns:
            self.now = max(self.now, due)
            for timer in reversed(self._timers):  # as a TimerThread: the last may hand on to earlier ones
                timer.due(self.now)
        self.now = max(self.now, to_ns)

    def close(self) -> None:
        """Stop as the router does: end frames, send what waits, and let armed deadmen send last."""
        last = [timer for timer in self._timers if isinstance(timer, Deadman)]
        for timer in [each for each in reversed(self._timers) if each not in last] + last[::-1]:
            timer.end(self.now)

    def _next_due(self) -> int | None:
        return min((timer.next_due for timer in self._timers if timer.next_due is not None), default=None)

    def _arrival(self) -> int:
        return self.now if self._arrived_at is None else self._arrived_at

    def _context(self, program: Program) -> EngineContext:
        counts = _ObservedCounts(program, self._count)
        send = {to.name: self._send for to in program.senders}
        deadmen = {
            plan.route: Deadman(plan, program.counters, counts, send, self._report, self._deadman_changed)
            for plan in program.deadmen
        }
        pacers = {to.name: Pacer(to.bandwidth) for to in program.senders if to.bandwidth}
        self._timers += pacers.values()  # before what hands on to them
        group = TimerGroup(counts, self._locked)
        return EngineContext(
            counts=counts,
            send=send,
            publish={plan.label: self._publish for plan in program.publishers},
            wanted={plan.label: [True] for plan in program.publishers},
            report=self._report,
            clock_ns=lambda: self.now,
            wall_ns=lambda: self.now,
            pacing=group,
            holding=group,
            collecting=group,
            command=commander(send, deadmen, self._locked, lambda: self.now),
            pacers=pacers,
            boards=program.boards,
        )

    def _locked(self, timer: Timer, call: Callable[P, R]) -> Callable[P, R]:
        if timer not in self._timers:
            self._timers.append(timer)
        return call

    def _send(self, data: bytes) -> int:
        self._data = data
        return len(data)

    def _publish(self, cdr: bytes) -> None:
        self._data = bytes(cdr)

    def _count(self, series: Series) -> None:
        """Make an event of what is counted: only the counters have both the route and the target."""
        self.events.append(_EVENTS[series.metric](self.now, series.labels, self._data))

    def _report(self, report: Report) -> None:
        """Add to the event of the last count what the engine reports about it."""
        event = self.events[-1]
        if isinstance(event, (Dropped, Rejected)):
            self.events[-1] = replace(event, detail=report.detail or str(report.error or ""))

    def _deadman_changed(self, route: str, active: bool) -> None:
        self.events.append(DeadmanChanged(self.now, route, active))


class _ObservedCounts(list[int]):
    """The counts of a program, with a call for each series of an event that is counted."""

    def __init__(self, program: Program, counted: Callable[[Series], None]) -> None:
        super().__init__(program.counters.fresh_counts())
        self._series = {index: series for series, index in program.counters.series() if series.metric in _EVENTS}
        self._counted = counted

    def __setitem__(self, index, value) -> None:  # type: ignore[no-untyped-def]  # it is never a slice
        super().__setitem__(index, value)
        if index in self._series:
            self._counted(self._series[index])

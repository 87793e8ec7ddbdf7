"""A program on a simulated clock: messages go in, a list of events comes out.

The library that drives the rover executes it (`carrier.simulation`). Every topic has a subscriber,
and the network accepts everything. Gateways do not take part, and deadmen do not send at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from router.carrier.events import CountedReport, DeadmanChange, StateChange
from router.carrier.simulation import Increment, Output, Simulation, Time
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Answer, Series
from router.datagrams import Peer
from router.library import library
from router.services.calls import HEADER, SIZE_OF_NUMBER

START = 1_767_225_600_000_000_000
"""The time at the start, unless another one is given: the beginning of 2026, in ns of the wall clock."""


# Events


@dataclass(frozen=True, slots=True)
class Event:
    """What happened to a message at `at`, ns of the rehearsal's clock."""

    at: int


@dataclass(frozen=True, slots=True)
class Received(Event):
    """A route took a message from `source`: an endpoint, `unknown`, or a ROS topic."""

    route: str
    source: str


@dataclass(frozen=True, slots=True)
class Sent(Event):
    """A datagram for an endpoint; `by_deadman` if the route's deadman sent it in place of a command."""

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
    """A target did not get a message, for one of metrics.DROP_REASONS; `detail` may say more."""

    route: str
    target: str
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Filtered(Event):
    """`when` withheld a message from a target, or a frame already had the datagram."""

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
class Superseded(Event):
    """A datagram has several payloads; protobuf keeps only the last one."""

    listener: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class DeadmanChanged(Event):
    """A route's deadman tripped, or was released."""

    route: str
    active: bool


@dataclass(frozen=True, slots=True)
class Obeyed(Event):
    """An endpoint has shown, `after` ns from the first brake of a route's deadman, that it obeys."""

    route: str
    target: str
    after: int


@dataclass(frozen=True, slots=True)
class Disobeyed(Event):
    """An endpoint has not shown in time that it obeys the brake of a route's deadman."""

    route: str
    target: str


@dataclass(frozen=True, slots=True)
class StateChanged(Event):
    """The value of a state changed. `source` set it; None if it expired."""

    state: str
    before: str
    after: str
    source: str | None


EVENTS: Mapping[str, Callable[[int, tuple[str, ...], bytes], Event]] = {
    "messages_received": lambda at, labels, _: Received(at, *labels),
    "datagrams_sent": lambda at, labels, data: Sent(at, labels[0], labels[1], data),
    "deadman_datagrams_sent": lambda at, labels, data: Sent(at, labels[0], labels[1], data, by_deadman=True),
    "messages_published": lambda at, labels, data: Published(at, labels[0], labels[1], data),
    "messages_dropped": lambda at, labels, _: Dropped(at, *labels),
    "messages_filtered": lambda at, labels, _: Filtered(at, *labels),
    "messages_collected": lambda at, labels, _: Collected(at, *labels),
    "superseded_members": lambda at, labels, _: Superseded(at, *labels),
    "datagrams_rejected": lambda at, labels, _: Rejected(at, *labels),
}
"""For each metric whose count is an event: a function from time, label values, and the last bytes to that event."""


# The run


class Rehearsal:
    """One run of a program, from the state of a router that has just started.

    `now` is the boot clock, in ns, and also the wall clock until that is set. `events` has what happened, in order; the
    caller may clear it. `states` has the present values, as the table writes them. The same calls give the same events.
    """

    def __init__(self, program: CompiledTable, start_ns: int = START) -> None:
        """Start the program. Raises StartError if the carrier's library is missing."""
        self.events: list[Event] = []
        self._simulation = Simulation(library(), start_ns)
        self._start = self._at = start_ns
        self.ahead = 0
        self._data = b""
        self._simulation.adopt(program)
        self._program, self._services = program, _services(program)
        self._series = _series(program)
        self._plans = {plan.name: plan for plan in program.states}
        self.states = self._initial()

    @property
    def now(self) -> int:
        return self._simulation.now

    @property
    def _wall(self) -> int:
        return self.now + self.ahead

    def datagram(self, listener: str, peer: Peer, data: bytes, arrived_ns: int | None = None) -> None:
        """Receive a datagram that waited in the socket since `arrived_ns`. Raises KeyError for an unknown listener."""
        self._simulation.datagram(listener, peer, data, self._wall if arrived_ns is None else arrived_ns)
        self._read()

    def ros(self, topic: str, cdr: bytes, sent_ns: int | None = None) -> None:
        """Take a message of a subscription, published at `sent_ns`. Raises KeyError for a topic without one."""
        if topic in self._services:
            cdr = self._services[topic].behind(cdr)
        self._simulation.message(topic, cdr, self._wall if sent_ns is None else sent_ns)
        self._read()

    def advance(self, to_ns: int) -> None:
        """Let time pass until `to_ns` and serve the timers that are due by then. Never goes back."""
        self._simulation.advance(to_ns)
        self._read()

    def set_clock(self, ahead_ns: int) -> None:
        """Set the wall clock to this many ns ahead of the boot clock."""
        self.ahead = ahead_ns
        self._simulation.set_clock(ahead_ns)

    def reload(self, program: CompiledTable) -> None:
        """Continue with another program, whose counters continue those of the current one."""
        self._simulation.adopt(program)
        self._program, self._services = program, _services(program)
        self._series |= _series(program)
        self._plans = {plan.name: plan for plan in program.states}
        self.states = self._initial() | {name: value for name, value in self.states.items() if name in self._plans}
        self._read()

    def restart(self) -> None:
        """Start again with the current program, as a router that has just started."""
        self._simulation.restart(self._start)
        self._at, self.ahead, self._data = self._start, 0, b""
        self._services = _services(self._program)
        self.states = self._initial()
        self.events.clear()

    def close(self) -> None:
        """Stop as the router does: end frames, send what waits, and let armed deadmen send last."""
        self._simulation.end()
        self._read()

    def _read(self) -> None:
        for record in self._simulation.records():
            match record:
                case Time(at):
                    self._at = at
                case Output(target, data):
                    self._data = self._services[target].taken(data) if target in self._services else data
                case Increment(counter, _):
                    self._count(counter)
                case DeadmanChange(route, is_tripped):
                    self.events.append(DeadmanChanged(self._at, route, is_tripped))
                case Answer(route, endpoint, True, after):
                    self.events.append(Obeyed(self._at, route, endpoint, after))
                case Answer(route, endpoint):
                    self.events.append(Disobeyed(self._at, route, endpoint))
                case StateChange():
                    self._change(record)
                case CountedReport(_, report):
                    self._report(report.detail or str(report.error or ""))

    def _initial(self) -> dict[str, str]:
        return {name: plan.shown(plan.initial) for name, plan in self._plans.items()}

    def _change(self, change: StateChange) -> None:
        plan = self._plans[change.state]
        before, after = plan.shown(change.before), plan.shown(change.after)
        self.states[change.state] = after
        self.events.append(StateChanged(self._at, change.state, before, after, change.source))

    def _count(self, counter: int) -> None:
        """Make an event from a counter: only counters have both the route and the target."""
        if (series := self._series.get(counter)) is not None:
            self.events.append(EVENTS[series.metric](self._at, series.labels, self._data))

    def _report(self, detail: str) -> None:
        """Add what is reported about the last count to its event."""
        event = self.events[-1]
        if isinstance(event, (Dropped, Rejected, Superseded)):
            self.events[-1] = replace(event, detail=detail)


class _Service:
    """Adds to messages of a service what precedes them in the carrier, and removes it: the number of a call, or what is
    kept of the last message that called it.
    """

    def __init__(self, kept: int, *, is_numbered: bool) -> None:
        self._size, self._is_numbered = kept, is_numbered
        self._first = bytes(kept)

    def behind(self, message: bytes) -> bytes:
        if self._is_numbered:
            self._first = (int.from_bytes(self._first, "little") + 1).to_bytes(self._size, "little")
        return message[:HEADER] + self._first + message[HEADER:]

    def taken(self, message: bytes) -> bytes:
        end = HEADER + self._size
        if not self._is_numbered:
            self._first = message[HEADER:end]
        return message[:HEADER] + message[end:]


def _services(program: CompiledTable) -> dict[str, _Service]:
    """Return the services of a program by what stands for them in place of topics."""
    services = {plan.label: _Service(SIZE_OF_NUMBER, is_numbered=True) for plan in program.services}
    for plan in program.called:
        services[plan.label] = services[plan.failed] = _Service(plan.kept, is_numbered=False)
    return services


def _series(program: CompiledTable) -> dict[int, Series]:
    """Return the series of events by the counters of a program."""
    return {index: series for series, index in program.counters.series() if series.metric in EVENTS}

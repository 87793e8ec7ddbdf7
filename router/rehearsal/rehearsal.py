"""A program on a simulated clock: messages go in, a list of events comes out.

The library that drives the rover executes it (`carrier.simulation`). Every topic has a subscriber,
and the network accepts everything. Gateways do not take part, and deadmen do not send at the start. Messages of
services are mapped; `stage` pairs calls with replies.
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
    """A message for a topic, under the name that the table gives it; `data` are its CDR bytes.

    With the label of a service as `target`, it is a reply, or a request of an endpoint. `leading` are then the bytes
    that precede it in the carrier: the value of `match`, or what is kept for its reply.
    """

    route: str
    target: str
    data: bytes
    leading: bytes = b""


@dataclass(frozen=True, slots=True)
class Dropped(Event):
    """A target did not get a message, for one of metrics.DROP_REASONS; `detail` may say more."""

    route: str
    target: str
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Unanswered(Event):
    """A call of a service, here its label, has ended without a reply: with one of metrics.CALL_OUTCOMES."""

    target: str
    outcome: str


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
        self._program, self._leading = program, _leading(program)
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
        """Take a message of a subscription, published at `sent_ns`. Raises KeyError for a topic without one.

        With the label of a service, the message is as in the carrier, after a number or what is kept.
        """
        self._simulation.message(topic, cdr, self._wall if sent_ns is None else sent_ns)
        self._read()

    def repeat(self, label: str, datagram: bytes) -> None:
        """Send the datagram of a service's request again."""
        self._simulation.send_again(label, datagram)
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
        self._program, self._leading = program, _leading(program)
        self._series |= _series(program)
        self._plans = {plan.name: plan for plan in program.states}
        self.states = self._initial() | {name: value for name, value in self.states.items() if name in self._plans}
        self._read()

    def restart(self) -> None:
        """Start again with the current program, as a router that has just started."""
        self._simulation.restart(self._start)
        self._at, self.ahead, self._data = self._start, 0, b""
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
                case Output(_, data):
                    self._data = data
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
            event = EVENTS[series.metric](self._at, series.labels, self._data)
            if isinstance(event, Published) and event.target in self._leading:
                data, end = event.data, HEADER + self._leading[event.target]
                event = replace(event, data=data[:HEADER] + data[end:], leading=data[HEADER:end])
            self.events.append(event)

    def _report(self, detail: str) -> None:
        """Add what is reported about the last count to its event."""
        event = self.events[-1]
        if isinstance(event, (Dropped, Rejected, Superseded)):
            self.events[-1] = replace(event, detail=detail)


def _leading(program: CompiledTable) -> dict[str, int]:
    """Return how many bytes precede the messages of each service, by its label."""
    leading = {plan.label: SIZE_OF_NUMBER for plan in program.services}
    return leading | {plan.label: plan.kept for plan in program.called}


def _series(program: CompiledTable) -> dict[int, Series]:
    """Return the series of events by the counters of a program."""
    return {index: series for series, index in program.counters.series() if series.metric in EVENTS}

"""Binds a program to the open sockets, topics and timer threads.

`wire` is the seam between the compiled program and the outside world: it passes plain callables into the engines
(`send` by endpoint, `publish` by topic, clocks, counts) and gets back plain callables for the threads (`receive` by
listener, `take` by topic, `feed`). Neither side refers to the other in any other way, so that either may be replaced,
for example by a compiled carrier that receives, forwards, publishes and brakes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from router.app.sockets import SocketChange
from router.app.timers import Timers, TimerThread
from router.clock import monotonic_ns, wall_ns
from router.compiler.metrics import Counters
from router.compiler.program import DeadmanPlan, Program
from router.engine import InboundEngine, OutboundEngine
from router.engine.binding import EngineContext, State, TimerGroup
from router.engine.deadman import Deadman, FeedMaker, commander, feeder
from router.engine.dispatch import Receive, Take
from router.engine.pacing import Pacer
from router.log import logger
from router.observe.reports import Reporter

if TYPE_CHECKING:
    from router.ros.endpoints import RosChange
    from router.ros.router_node import RouterNode

Send = Callable[[bytes], int]


class ThreadCounts:
    """What was counted since the start, whatever tables the router has had: a list of counts for each thread or lock.

    `counters` are those of the running program and say what is counted at which index.
    """

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.lists = [counters.fresh_counts() for _ in range(8)]
        self.receive, self.ros, self.deadman, self.pacing, self.collecting = self.lists[:5]
        self.gateways, self.events, self.own = self.lists[5:]

    def total(self, metric: str) -> int:
        """The sum of a counter over all its labels."""
        indexes = [index for series, index in self.counters.series() if series.metric == metric]
        return sum(counts[index] for counts in self.lists for index in indexes)

    def make_room(self, counters: Counters) -> None:
        """Add the counts of `counters`, which continue the present ones."""
        present = dict(self.counters.series())
        new = [index for series, index in counters.series() if series not in present]
        for counts in self.lists:
            counters.grow(counts)
            for index in new:  # a program that was abandoned may have counted there
                counts[index] = 0

    def replace(self, counters: Counters) -> None:
        """Adopt `counters`, once no thread counts by the earlier ones."""
        counters.settle(self.lists)
        self.counters = counters  # from here on read by other threads, and no longer changed


@dataclass(frozen=True, slots=True)
class RouterContext:
    """What wiring uses of the router, whatever its program.

    `deadman_changed` is called with a route and whether its deadman is tripped.
    """

    counts: ThreadCounts
    timers: Timers
    reporter: Reporter
    deadman_changed: Callable[[str, bool], None]


@dataclass(frozen=True, slots=True)
class Wiring:
    """A program's functions: `receive` by listener, `take` by topic, `feed` for commands of gateway clients."""

    program: Program
    receive: Mapping[str, Receive]
    take: Mapping[str, Take]
    feed: FeedMaker
    state: State
    deadmen: Mapping[str, Deadman]
    pacers: Mapping[str, Pacer]
    engines: Sequence[InboundEngine | OutboundEngine]

    def start(self, timers: Timers) -> None:
        """Have deadmen behind gateways publish to each subscriber that is discovered shortly after the start."""
        for plan in _inbound_deadmen(self.program):
            deadman = self.deadmen[plan.route]
            timers.inbound_deadman.locked(deadman, deadman.await_subscribers)(monotonic_ns())

    def subscriber_joined(self, topic: str, timers: Timers) -> None:
        for plan in _inbound_deadmen(self.program):
            if topic in dict(plan.datagrams):
                deadman = self.deadmen[plan.route]
                _log_start(plan.route, timers.inbound_deadman.locked(deadman, deadman.greet)(monotonic_ns()))

    def free(self) -> None:
        """Free the functions, which are in reference cycles. None may be called afterwards."""
        for engine in self.engines:
            engine.close()

    def succeed(self, earlier: Wiring | None, timers: Timers) -> None:
        """Take over from `earlier`, while nothing is received: deadmen with other settings inherit their state.

        Timers that only `earlier` had end, so that messages that waited are sent before any that comes.
        """
        inbound = {plan.route for plan in _inbound_deadmen(self.program)}
        for route, deadman in self.deadmen.items():
            before = earlier.deadmen.get(route) if earlier else None
            if before is not None and before is not deadman:
                thread = timers.inbound_deadman if route in inbound else timers.deadman
                thread.locked(deadman, deadman.replace)(before)
        timers.release(list(self.state.left()))
        places = {(each.route, target.label) for each in self.program.handlers for target in each.targets}
        for pacer in self.pacers.values():
            timers.pacing.locked(pacer, pacer.keep_only)(monotonic_ns(), places)


def start_deadmen(program: Program, context: RouterContext, sockets: SocketChange, state: State) -> None:
    """Have the deadmen of routes send at the start. Needs the sockets only, because ROS takes seconds to open."""
    for plan in program.deadmen:
        deadman = _deadman(plan, program, context, _checked_senders(sockets), state)
        _log_start(plan.route, context.timers.deadman.locked(deadman, deadman.start)())


def wire(
    program: Program,
    context: RouterContext,
    sockets: SocketChange,
    ros: RouterNode | None,
    topics: RosChange | None,
    state: State,
) -> Wiring:
    """Bind `program` to the sockets and topics that it is to have."""
    counts, timers = context.counts, context.timers
    send: dict[str, Send] = {endpoint: sender.send for endpoint, sender in sockets.senders.items()}
    deadmen = _deadmen(program, context, _checked_senders(sockets), ros, state)
    pacers = _pacers(program, timers.pacing, send, state)
    engine_context = EngineContext(
        counts=counts.receive,
        send=send,
        publish={topic: each.publish for topic, each in topics.publications.items()} if topics else {},
        wanted={topic: each.wanted for topic, each in topics.publications.items()} if topics else {},
        report=context.reporter.report,
        clock_ns=monotonic_ns,
        wall_ns=wall_ns,
        pacing=TimerGroup(counts.pacing, timers.pacing.locked),
        collecting=TimerGroup(counts.collecting, timers.collecting.locked),
        command=commander(send, deadmen, timers.deadman.locked, monotonic_ns),
        publish_errors=ros.publish_errors if ros else (),
        pacers=pacers,
        state=state,
    )
    inbound = InboundEngine(
        program, engine_context, {name: each.arrived_at for name, each in sockets.listeners.items()}
    )
    outbound = OutboundEngine(program, replace(engine_context, counts=counts.ros))
    return Wiring(
        program=program,
        receive={name: inbound.receiver(name) for name in sockets.listeners},
        take={plan.label: outbound.taker(plan.label) for plan in program.subscriptions},
        feed=feeder(deadmen, timers.inbound_deadman.locked),
        state=state,
        deadmen=deadmen,
        pacers=pacers,
        engines=(inbound, outbound),
    )


def _deadmen(
    program: Program, context: RouterContext, send: Mapping[str, Send], ros: RouterNode | None, state: State
) -> dict[str, Deadman]:
    """The deadmen by route; those behind gateways send to topics."""
    inbound = _inbound_deadmen(program)
    destinations = dict(send)
    if ros is not None:
        for topic in {topic for plan in inbound for topic, _ in plan.datagrams}:
            destinations[topic] = state.keep(("sender to topic", topic), partial(_sender_to, ros, topic))
    return {plan.route: _deadman(plan, program, context, destinations, state) for plan in (*program.deadmen, *inbound)}


def _deadman(
    plan: DeadmanPlan, program: Program, context: RouterContext, destinations: Mapping[str, Send], state: State
) -> Deadman:
    def deadman() -> Deadman:
        counts = context.counts.deadman
        return Deadman(plan, program.counters, counts, destinations, context.reporter.report, context.deadman_changed)

    return state.keep(("deadman", plan, tuple(destinations[name] for name, _ in plan.datagrams)), deadman)


def _checked_senders(sockets: SocketChange) -> dict[str, Send]:
    """What deadmen send by, by endpoint: errors of a datagram are raised with it."""
    return {endpoint: sender.send_checked for endpoint, sender in sockets.senders.items()}


def _inbound_deadmen(program: Program) -> list[DeadmanPlan]:
    """The deadmen of what gateways let in."""
    return [each.deadman for gateway in program.gateways for each in gateway.inbound.values() if each.deadman]


def _log_start(route: str, sent_to: Sequence[str]) -> None:
    if sent_to:
        logger.info("the deadman has sent its payload, since the router starts", route=route, to=list(sent_to))


def _pacers(program: Program, pacing: TimerThread, send: Mapping[str, Send], state: State) -> dict[str, Pacer]:
    pacers = {}
    for endpoint in program.senders:
        if endpoint.budget:
            sending, budget = send[endpoint.name], endpoint.budget
            pacer = state.keep(("pacer", endpoint.name, budget, sending), partial(Pacer, budget))
            pacing.add(pacer)  # before the timers that pass on to it, as they have to end first
            pacers[endpoint.name] = pacer
    return pacers


def _sender_to(ros: RouterNode, topic: str) -> Send:
    """Return a function that publishes with the interface of a socket's `send`."""

    def send(message: bytes) -> int:
        try:
            ros.publish[topic](message)
        except ros.publish_errors as error:
            raise OSError(f"it cannot be published: {error}") from error
        return len(message)

    return send

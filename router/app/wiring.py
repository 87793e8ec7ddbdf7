"""Binds a program to what is open: the functions that the threads call, and what these remember."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from router.app.accounts import Accounts
from router.app.sockets import SocketChange
from router.app.timers import TimerThread
from router.clock import monotonic_ns, wall_ns
from router.compiler.program import DeadmanPlan, Program
from router.engine import InboundEngine, OutboundEngine
from router.engine.binding import EngineContext, State, TimerGroup
from router.engine.deadman import Deadman, FeedMaker, feeder
from router.engine.dispatch import Receive, Take
from router.engine.pacing import Pacer
from router.log import logger
from router.observe.reports import Reporter

if TYPE_CHECKING:
    from router.ros.change import RosChange
    from router.ros.node_and_publishers import RosEdge

Send = Callable[[bytes], int]


class Keepers:
    """One for deadmen, which never wait for other machines; those of what gateways let in publish, which may block in
    the middleware, so they have one of their own. One for what waits to be sent, one for open frames.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self.deadman, self.inbound_deadman, self.pacing, self.collecting = (
            TimerThread(name, monotonic_ns, failed) for name in ("deadman", "inbound deadman", "pacing", "collect")
        )

    def start(self) -> None:
        for keeper in (self.deadman, self.inbound_deadman, self.pacing, self.collecting):
            keeper.start()

    def release(self, machines: Sequence[object]) -> None:
        """Ends those that are machines: frames first, then what waits to be sent; a deadman has the last word."""
        for keeper in (self.collecting, self.pacing, self.inbound_deadman, self.deadman):
            keeper.release(machines)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What wiring needs of the router, whatever its program is. `deadman_changed` hears a route and whether it acts."""

    accounts: Accounts
    keepers: Keepers
    reporter: Reporter
    deadman_changed: Callable[[str, bool], None]


@dataclass(frozen=True, slots=True)
class Wiring:
    """A program's functions: `receive` by listener, `take` by topic.

    `feed` makes what tells deadmen of what clients send.
    """

    program: Program
    receive: Mapping[str, Receive]
    take: Mapping[str, Take]
    feed: FeedMaker
    state: State
    deadmen: Mapping[str, Deadman]
    pacers: Mapping[str, Pacer]
    cuts: Sequence[Callable[[], None]]

    def begin(self, keepers: Keepers) -> None:
        """The router starts: has deadmen that publish do so as soon as a subscriber is met."""
        for plan in _inbound_deadmen(self.program):
            deadman = self.deadmen[plan.route]
            keepers.inbound_deadman.locked(deadman, deadman.await_subscribers)(monotonic_ns())

    def meet(self, topic: str, keepers: Keepers) -> None:
        """Somebody new subscribes to `topic`."""
        for plan in _inbound_deadmen(self.program):
            if topic in dict(plan.datagrams):
                deadman = self.deadmen[plan.route]
                _tell_start(plan.route, keepers.inbound_deadman.locked(deadman, deadman.greet)(monotonic_ns()))

    def forget(self) -> None:
        """Nobody calls the functions any more. Each is in a ring with its globals; cut, they are gone at once."""
        for cut in self.cuts:
            cut()

    def succeed(self, earlier: Wiring | None, keepers: Keepers) -> None:
        """Ends what only `earlier` had, while nothing is received: what waited is sent before anything that comes.

        Each deadman with other settings than before takes its predecessor's place first.
        """
        inbound = {plan.route for plan in _inbound_deadmen(self.program)}
        for route, deadman in self.deadmen.items():
            before = earlier.deadmen.get(route) if earlier else None
            if before is not None and before is not deadman:
                keeper = keepers.inbound_deadman if route in inbound else keepers.deadman
                keeper.locked(deadman, deadman.replace)(before)
        keepers.release(list(self.state.left()))
        places = {(each.route, target.target) for each in self.program.handlers for target in each.targets}
        for pacer in self.pacers.values():
            keepers.pacing.locked(pacer, pacer.keep_only)(monotonic_ns(), places)


def begin(program: Program, around: Surroundings, sockets: SocketChange, state: State) -> None:
    """The router starts: has the deadmen of routes send. That needs the sockets only; ROS takes seconds to open."""
    for plan in program.deadmen:
        deadman = _deadman(plan, program, around, _looking(sockets), state)
        _tell_start(plan.route, around.keepers.deadman.locked(deadman, deadman.start)())


def wire(
    program: Program,
    around: Surroundings,
    sockets: SocketChange,
    ros: RosEdge | None,
    topics: RosChange | None,
    state: State,
) -> Wiring:
    """For the sockets and topics that `program` is to have."""
    accounts, keepers = around.accounts, around.keepers
    send: dict[str, Send] = {endpoint: sender.send for endpoint, sender in sockets.senders.items()}
    deadmen = _deadmen(program, around, _looking(sockets), ros, state)
    pacers = _pacers(program, keepers.pacing, send, state)
    context = EngineContext(
        counts=accounts.receive,
        send=send,
        publish={topic: each.publish for topic, each in topics.publications.items()} if topics else {},
        wanted={topic: each.wanted for topic, each in topics.publications.items()} if topics else {},
        report=around.reporter.report,
        clock_ns=monotonic_ns,
        wall_ns=wall_ns,
        pacing=TimerGroup(accounts.pacing, keepers.pacing.locked),
        collecting=TimerGroup(accounts.collecting, keepers.collecting.locked),
        feed=feeder(deadmen, keepers.deadman.locked),
        publish_errors=ros.publish_errors if ros else (),
        pacers=pacers,
        state=state,
    )
    inbound = InboundEngine(program, context, {name: each.arrived_at for name, each in sockets.listeners.items()})
    outbound = OutboundEngine(program, replace(context, counts=accounts.ros))
    return Wiring(
        program=program,
        receive={name: inbound.receiver(name) for name in sockets.listeners},
        take={plan.label: outbound.taker(plan.label) for plan in program.subscriptions},
        feed=feeder(deadmen, keepers.inbound_deadman.locked),
        state=state,
        deadmen=deadmen,
        pacers=pacers,
        cuts=(inbound.close, outbound.close),
    )


def _deadmen(
    program: Program, around: Surroundings, send: Mapping[str, Send], ros: RosEdge | None, state: State
) -> dict[str, Deadman]:
    """By route; those of what gateways let in send to topics."""
    inbound = _inbound_deadmen(program)
    outlets = dict(send)
    if ros is not None:
        for topic in {topic for plan in inbound for topic, _ in plan.datagrams}:
            outlets[topic] = state.keep(("sender to topic", topic), partial(_sender_to, ros, topic))
    return {plan.route: _deadman(plan, program, around, outlets, state) for plan in (*program.deadmen, *inbound)}


def _deadman(
    plan: DeadmanPlan, program: Program, around: Surroundings, outlets: Mapping[str, Send], state: State
) -> Deadman:
    def deadman() -> Deadman:
        counts = around.accounts.deadman
        return Deadman(plan, program.counters, counts, outlets, around.reporter.report, around.deadman_changed)

    return state.keep(("deadman", plan, tuple(outlets[name] for name, _ in plan.datagrams)), deadman)


def _looking(sockets: SocketChange) -> dict[str, Send]:
    """How deadmen send, by endpoint."""
    return {endpoint: sender.send_and_look for endpoint, sender in sockets.senders.items()}


def _inbound_deadmen(program: Program) -> list[DeadmanPlan]:
    """Of what gateways let in."""
    return [each.deadman for gateway in program.gateways for each in gateway.inbound.values() if each.deadman]


def _tell_start(route: str, sent_to: Sequence[str]) -> None:
    if sent_to:
        logger.info("the deadman has sent its payload, since the router starts", route=route, to=list(sent_to))


def _pacers(program: Program, keeper: TimerThread, send: Mapping[str, Send], state: State) -> dict[str, Pacer]:
    pacers = {}
    for plan in program.senders:
        if plan.budget:
            sending, budget = send[plan.endpoint], plan.budget
            pacer = state.keep(("pacer", plan.endpoint, budget, sending), partial(Pacer, budget, sending))
            keeper.add(pacer)  # before what hands on to it, so that it is ended after that
            pacers[plan.endpoint] = pacer
    return pacers


def _sender_to(ros: RosEdge, topic: str) -> Send:
    """Publishes as a socket sends: a deadman knows no topics."""

    def send(message: bytes) -> int:
        try:
            ros.publish[topic](message)
        except ros.publish_errors as error:
            raise OSError(f"it cannot be published: {error}") from error
        return len(message)

    return send

"""What a program's functions need of the running router, and what the threads need of them.

`wiring` has what is the same however datagrams are received. The rest is a datapath: `python_datapath` calls generated
handlers for everything, `native_datapath` has the carrier do what it can. Nothing else brings compiled handlers
together with sockets and topics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol

from router.app.sockets import SocketChange
from router.app.timers import Timers, TimerThread
from router.clock import boottime_ns, wall_ns
from router.compiler.metrics import Counters
from router.compiler.program import DeadmanPlan, Program
from router.engine.binding import EngineContext, State, TimerGroup
from router.engine.deadman import CommandMaker, Deadman, FeedMaker
from router.engine.dispatch import Take
from router.engine.pacing import Pacer
from router.errors import StartError
from router.log import logger
from router.net.udp import Listener, Sender
from router.observe.reports import Reporter
from router.table import model

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
        self.most: int | None = None
        """The length of a list that cannot grow, if there is one."""
        self.lists: list[list[int]] = []
        self._copies: list[Callable[[int], list[int]]] = []
        self._forgetful: list[Callable[[], None]] = []
        for _ in range(10):
            self.add(counters.fresh_counts())
        self.receive, self.ros, self.deadman, self.gateway_deadmen, self.pacing, self.holding = self.lists[:6]
        self.collecting, self.gateways, self.events, self.own = self.lists[6:]

    def add(
        self,
        counts: list[int],
        copy: Callable[[int], list[int]] | None = None,
        forget: Callable[[], None] = lambda: None,
    ) -> None:
        """Count in another list too. `copy(size)` returns its beginning at a time at which it balances.

        After `forget`, it returns nothing that was counted before.
        """
        self.counters.grow(counts)
        self._forgetful.append(forget)
        self.lists.append(counts)
        self._copies.append(copy or (lambda size: counts[:size]))

    def copies(self, size: int) -> list[list[int]]:
        """Return the first `size` counts, each list at one instant: between two messages, as far as that is known."""
        return [copy(size) for copy in self._copies]

    def total(self, metric: str) -> int:
        """The sum of a counter over all its labels."""
        indexes = [index for series, index in self.counters.series() if series.metric == metric]
        return sum(counts[index] for counts in self.lists for index in indexes)

    def make_room(self, counters: Counters) -> None:
        """Add the counts of `counters`, which continue the present ones. Raises StartError."""
        if self.most is not None and counters.size > self.most:
            what = f"the table has {counters.size} counters, and the carrier has room for {self.most}"
            raise StartError(what, "with ROUTER_CARRIER=python there is no limit")
        present = dict(self.counters.series())
        new = [index for series, index in counters.series() if series not in present]
        for counts in self.lists:
            counters.grow(counts)
            for index in new:  # a program that was abandoned may have counted there
                counts[index] = 0

    def replace(self, counters: Counters) -> None:
        """Adopt `counters`, once no thread counts by the earlier ones."""
        counters.settle(self.lists)
        for forget in self._forgetful:  # what was freed there
            forget()
        self.adopt(counters)

    def adopt(self, counters: Counters) -> None:
        """As `replace`, while a thread may still count by the earlier ones, whose indexes stay taken."""
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


class States:
    """What a program keeps from one message to the next, by who uses it; `previous` are those of the program before."""

    def __init__(self, users: Sequence[str], previous: States | None) -> None:
        self._by_user = {user: State(previous[user] if previous else None) for user in users}

    def __getitem__(self, user: str) -> State:
        return self._by_user[user]

    def added(self) -> list[object]:
        """The objects that the previous program does not have."""
        return [each for state in self._by_user.values() for each in state.added()]

    def forget_previous(self) -> None:
        for state in self._by_user.values():
            state.forget_previous()


@dataclass(frozen=True, slots=True)
class Wiring:
    """A program's functions: `take` by topic, `feed` for commands of gateway clients.

    `gateway_deadmen` are those of what gateways let in, by name.
    """

    program: Program
    take: Mapping[str, Take]
    feed: FeedMaker
    states: States
    gateway_deadmen: Mapping[str, Deadman]
    pacers: Mapping[str, Pacer]
    engines: Sequence[Closable]

    def start(self, timers: Timers) -> None:
        """Have deadmen behind gateways publish to each subscriber that is discovered shortly after the start."""
        for deadman in self.gateway_deadmen.values():
            timers.inbound_deadman.locked(deadman, deadman.await_subscribers)(boottime_ns())

    def subscriber_joined(self, topic: str, timers: Timers) -> None:
        for plan in inbound_deadmen(self.program):
            if topic in dict(plan.datagrams):
                deadman = self.gateway_deadmen[plan.route]
                log_start(plan.route, timers.inbound_deadman.locked(deadman, deadman.greet)(boottime_ns()))

    def free(self) -> None:
        """Free the functions, which are in reference cycles. None may be called afterwards."""
        for engine in self.engines:
            engine.close()

    def settle_pacers(self, timers: Timers) -> None:
        """Send what waits in pacers for targets that the program does not have."""
        places = {(each.route, target.label) for each in self.program.handlers for target in each.targets}
        for pacer in self.pacers.values():
            timers.pacing.locked(pacer, pacer.keep_only)(boottime_ns(), places)

    def check_gateways(self, earlier: Wiring | None, timers: Timers) -> None:
        """Raise StuckError if `succeed_gateways` would wait for the middleware."""
        if self._successions(earlier):
            timers.inbound_deadman.check()

    def succeed_gateways(self, earlier: Wiring | None, timers: Timers) -> None:
        """Have deadmen of gateways with other settings inherit the state of those in `earlier`."""
        for deadman, before in self._successions(earlier):
            timers.inbound_deadman.locked(deadman, deadman.replace)(before)

    def _successions(self, earlier: Wiring | None) -> list[tuple[Deadman, Deadman]]:
        """The deadmen of gateways with other settings, each with the one in `earlier`."""
        before = earlier.gateway_deadmen if earlier else {}
        return [
            (each, before[name]) for name, each in self.gateway_deadmen.items() if before.get(name, each) is not each
        ]


class Closable(Protocol):
    def close(self) -> None: ...


class Datapath(Protocol):
    """Receives the datagrams of listeners, forwards them, feeds deadmen and brakes."""

    @property
    def turns(self) -> int:
        """A number that grows unless the thread that receives is stuck, even if nothing comes."""

    def stalled(self) -> tuple[str, float] | None:
        """The topic in whose publisher a native thread is now, and for how many seconds."""

    def open_listener(self, settings: model.Listener, has_senders: bool) -> Listener:
        """Bind a socket. Raises StartError."""

    def open_sender(self, endpoint: model.Endpoint, source: Listener | None, listeners: Sequence[Listener]) -> Sender:
        """Open a socket to an endpoint, as `Sender`. Raises OSError."""

    def states(self, earlier: Wiring | None) -> States: ...

    def start_deadmen(self, program: Program, sockets: SocketChange, states: States) -> None:
        """Have the deadmen of routes send at the start. Needs the sockets only, because ROS takes seconds to open."""

    def wire(
        self,
        program: Program,
        sockets: SocketChange,
        ros: RouterNode | None,
        topics: RosChange | None,
        states: States,
    ) -> Wiring:
        """Bind `program` to the sockets and topics that it is to have."""

    def abandon(self, wiring: Wiring) -> None:
        """Undo `wire`, for a program that will not run."""

    def between(self, wiring: Wiring, swap: Callable[[], None]) -> None:
        """Call `swap`, which calls `adopt` with this wiring, when it does not disturb what the running program does.

        Raises StuckError, and what `swap` raises, with nothing changed.
        """

    def adopt(self, wiring: Wiring, earlier: Wiring | None, left: Sequence[Listener], now: Sequence[Listener]) -> None:
        """Receive with another program from the listeners `now`, and no longer from `left`, which are emptied.

        Deadmen with other settings inherit their state. Timers that only `earlier` had end, so that messages that
        waited are sent before any that comes.
        """

    def start(self) -> None:
        """Begin to receive with the program that was adopted."""

    def has_passed(self, wiring: Wiring) -> bool:
        """Wait until nothing of an earlier program is in use. Return False where that takes longer than a second."""

    def observe(self, *, is_observed: bool) -> None:
        """Begin or cease to show received datagrams to the mirror."""

    def watch(self, notify: int, interval: int) -> bool:
        """Feed a watchdog by a connected socket, every `interval` ns. Return False where the caller has to do it."""

    def stop(self, listeners: Sequence[Listener]) -> None:
        """End all input, handle what the kernel holds and what waits, and end the threads.

        What is in an inherited socket stays there, for the next process.
        """

    def close(self) -> None:
        """Have deadmen send a last time. Nothing is sent afterwards."""


def engine_context(
    program: Program,
    context: RouterContext,
    topics: RosChange | None,
    publish_errors: tuple[type[Exception], ...],
    send: Mapping[str, Send],
    command: CommandMaker,
    pacers: Mapping[str, Pacer],
) -> EngineContext:
    """What engines share; `counts` and `state` have to be replaced by those of each engine."""
    counts, timers = context.counts, context.timers
    publications = topics.publications if topics else {}
    return EngineContext(
        counts=counts.receive,
        send=send,
        publish={topic: each.publish for topic, each in publications.items()},
        wanted={topic: each.wanted for topic, each in publications.items()},
        report=context.reporter.report,
        clock_ns=boottime_ns,
        wall_ns=wall_ns,
        pacing=TimerGroup(counts.pacing, timers.pacing.locked),
        holding=TimerGroup(counts.holding, timers.holding.locked),
        collecting=TimerGroup(counts.collecting, timers.collecting.locked),
        command=command,
        publish_errors=publish_errors,
        pacers=pacers,
        boards=program.boards,
    )


def gateway_deadmen(
    program: Program, context: RouterContext, ros: RouterNode | None, state: State
) -> dict[str, Deadman]:
    """The deadmen of what gateways let in, by name: they publish."""
    if ros is None:
        return {}
    deadmen = {}
    for plan in inbound_deadmen(program):
        destinations = {
            topic: state.keep(("sender to topic", topic), partial(_sender_to, ros, topic))
            for topic, _ in plan.datagrams
        }
        counts = context.counts.gateway_deadmen
        deadmen[plan.route] = python_deadman(plan, program, context, counts, destinations, state)
    return deadmen


def python_deadman(
    plan: DeadmanPlan,
    program: Program,
    context: RouterContext,
    counts: list[int],
    destinations: Mapping[str, Send],
    state: State,
) -> Deadman:
    """The deadman of a plan, by Python; `destinations` by endpoint or topic."""

    def deadman() -> Deadman:
        return Deadman(plan, program.counters, counts, destinations, context.reporter.report, context.deadman_changed)

    return state.keep(("deadman", plan, tuple(destinations[name] for name, _ in plan.datagrams)), deadman)


def inbound_deadmen(program: Program) -> list[DeadmanPlan]:
    """The deadmen of what gateways let in."""
    return [each.deadman for gateway in program.gateways for each in gateway.inbound.values() if each.deadman]


def log_start(route: str, sent_to: Sequence[str]) -> None:
    if sent_to:
        logger.info("the deadman has sent its payload, since the router starts", route=route, to=list(sent_to))


def open_pacers(program: Program, pacing: TimerThread, send: Mapping[str, Send], state: State) -> dict[str, Pacer]:
    """The pacers of endpoints with a bandwidth, by endpoint."""
    pacers = {}
    for endpoint in program.senders:
        if endpoint.bandwidth:
            sending, bandwidth = send[endpoint.name], endpoint.bandwidth
            pacer = state.keep(("pacer", endpoint.name, bandwidth, sending), partial(Pacer, bandwidth))
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

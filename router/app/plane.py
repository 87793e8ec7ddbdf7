"""The native threads, and the program that they execute.

`build` makes arrays of a compiled program and of what is open for it; `adopt` has each thread change to them between
two messages. What a thread has received before, it serves by the earlier program. What a program keeps from one message
to the next goes along by key.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import count
from time import monotonic, sleep

from router import declared as c
from router.app.counts import ThreadCounts
from router.app.from_ros import FromRos, RosTopics
from router.app.publishing import Publishing, functions_of_rcl
from router.carrier.boards import NativeBoards
from router.carrier.carrier import Carrier
from router.carrier.client_deadmen import ClientDeadman, ClientDeadmen
from router.carrier.collectors import NativeCollector, kept_collector
from router.carrier.deadmen import Deadmen, NativeDeadman
from router.carrier.deferrals import Adoption, Deferrals, NativeDeferral, NativePacer, timer_change
from router.carrier.events import EventReader, EventThread
from router.carrier.from_ros import Subscription, native_from_ros
from router.carrier.limits import open_limit
from router.carrier.mirror import MirrorRing
from router.carrier.outlets import Names, Outlets, Publication
from router.carrier.program import NativeProgram, native_program
from router.carrier.reasons import where_refused, why_rejected
from router.carrier.ring import Ring
from router.carrier.sender import NativeSender
from router.carrier.state import State
from router.clock import boottime_ns
from router.compiler.program import DeadmanPlan, Program, RoutePlan, TargetPlan
from router.errors import StartError
from router.log import logger
from router.net.udp import Listener
from router.observe.reports import Reporter
from router.recording.mirror import Mirror

_PUBLISHED, _MIRRORED, _EVENTS = 1 << 20, 1 << 22, 1 << 18
"""Bytes that may wait: messages for topics, received datagrams for observers, and events of a thread."""

_PATIENCE_S = 1.0
"""How long a reload waits for a thread that may be stuck in the middleware."""

_TURN_S = 0.002


@dataclass(frozen=True, slots=True)
class Opened:
    """What is open for a program, and what it keeps. Publications and subscriptions are by topic."""

    listeners: Mapping[str, Listener]
    senders: Mapping[str, NativeSender]
    publications: Mapping[str, Publication]
    subscriptions: Mapping[str, Subscription]
    state: State


@dataclass(frozen=True, slots=True)
class Built:
    """A program as the threads execute it. `deadmen` are those of routes, others those of clients, by name.

    `adopted` is what holds messages back, and collects them.
    """

    program: Program
    state: State
    native: NativeProgram
    topics: RosTopics
    adopted: Sequence[Adoption]
    deadmen: Mapping[str, NativeDeadman]
    client_deadmen: Mapping[str, ClientDeadman]


class Plane:
    """Receives, forwards, publishes and brakes. `changed` is called with a route and whether its deadman is tripped."""

    def __init__(
        self,
        library: ctypes.CDLL,
        counts: ThreadCounts,
        mirror: Mirror,
        reporter: Reporter,
        changed: Callable[[str, bool], None],
    ) -> None:
        self.now: Built | None = None
        """What runs."""
        self._library = library
        self._counters = counts
        self._names = Names()
        self._generations = count(1)
        self._is_running = self.has_stopped = False
        braking, guarding, publishing, receiving, *from_ros = (ThreadCounts.fixed() for _ in range(6))
        braked, guarded, published, received, *taken = (Ring(library, _EVENTS) for _ in range(6))
        self._deadmen = Deadmen(library, braking, braked, self._names)
        self._client_deadmen = ClientDeadmen(library, guarding, guarded, self._names)
        self._publishing = Publishing(library, Ring(library, _PUBLISHED), publishing, published, self._names)
        self._carrier = Carrier(library, self._deadmen.address, receiving, received, self._publishing.ring)
        self._from_ros = [
            FromRos(library, self._deadmen.address, counted, events, is_urgent=is_urgent)
            for is_urgent, counted, events in zip((True, False), from_ros, taken, strict=True)
        ]
        told = [
            (braked, counts.add_fixed(braking)),
            (guarded, counts.add_fixed(guarding)),
            # Before those of the receive thread: what was published was received, so no less than 0 waits.
            (published, counts.add_fixed(publishing, self._publishing.counters)),
            (received, counts.add_fixed(receiving, self._carrier.counters)),
        ]
        for thread, counted, events in zip(self._from_ros, from_ros, taken, strict=True):
            told.append((events, counts.add_fixed(counted, thread.counters)))
        self._mirrored = MirrorRing(Ring(library, _MIRRORED), self._names)
        mirror.show(self._mirrored.take, lambda: counts.total("mirror_dropped"))
        reader = EventReader(self._names, self._why_rejected, self._where_refused)
        self._events = EventThread(told, reader, reporter.report, changed, self._pulse)

    @property
    def turns(self) -> int:
        """A number that grows unless the receive thread is stuck, even if nothing comes."""
        return self._carrier.turns

    def stalled(self) -> Iterator[tuple[str, float]]:
        """The topics in whose publishers native threads are now, each with seconds."""
        return filter(None, (self._publishing.stalled(), self._client_deadmen.stalled()))

    def _pulse(self) -> None:
        self._carrier.pulse()
        for thread in self._from_ros:
            thread.report_failures()

    # a program

    def start_deadmen(self, program: Program, senders: Mapping[str, NativeSender], state: State) -> None:
        """Have deadmen send at the start of the router. That needs sockets only: ROS takes seconds to open."""
        for plan in program.deadmen:
            log_start(plan.route, self._deadman(plan, program, senders, state).start(boottime_ns()))

    def build(self, program: Program, opened: Opened) -> Built:
        """Make the arrays of a program. Raises StartError."""
        deadmen = {plan.route: self._deadman(plan, program, opened.senders, opened.state) for plan in program.deadmen}
        generation = next(self._generations)
        if program.publishers:
            self._publishing.open()
        bandwidths = {each.name: each.bandwidth for each in program.senders if each.bandwidth is not None}
        deferrals = Deferrals(self._library, opened.state, opened.senders, opened.publications, bandwidths)
        outlets = Outlets(
            listeners=opened.listeners,
            senders={endpoint: sender.address for endpoint, sender in opened.senders.items()},
            publications=opened.publications,
            feeds=lambda route, names: [(deadmen[name].address, name != route) for name in names],
            limit=partial(_limit, opened.state),
            deferral=deferrals.deferral,
            collector=partial(kept_collector, self._library, opened.state),
            names=self._names,
            boards=NativeBoards(program.boards),
        )
        native = native_program(program, generation, outlets)
        messages = native_from_ros(program, generation, outlets)
        for arrays in (native.arrays, messages.arrays):
            arrays += [opened.senders, deadmen]
        for thread in self._from_ros:
            thread.open(messages)
        topics = RosTopics(messages, opened.subscriptions)
        pacers = [Adoption(pacer.address) for pacer in deferrals.pacers()]
        adopted = [*pacers, *native.states.adopted, *messages.states.adopted]
        clients = self._deadmen_of_clients(program, opened)
        return Built(program, opened.state, native, topics, adopted, deadmen, clients)

    def _deadman(
        self, plan: DeadmanPlan, program: Program, senders: Mapping[str, NativeSender], state: State
    ) -> NativeDeadman:
        used = {endpoint: senders[endpoint] for endpoint, _ in plan.datagrams}
        key = "deadman", plan, tuple(used.values())
        return state.keep(key, lambda: self._deadmen.add(plan, program.counters, used))

    def _deadmen_of_clients(self, program: Program, opened: Opened) -> dict[str, ClientDeadman]:
        """Their thread serves them from now on: clients may publish before the program runs. Raises StartError."""
        made = {plan.route: self._client_deadman(plan, program, opened) for plan in program.client_deadmen}
        if made:
            try:
                self._client_deadmen.start(functions_of_rcl(self._library))
            except OSError as error:
                raise StartError(str(error)) from error
        if self.now is None:
            for deadman in made.values():
                deadman.await_subscribers(boottime_ns())
        return made

    def _client_deadman(self, plan: DeadmanPlan, program: Program, opened: Opened) -> ClientDeadman:
        used = {topic: opened.publications[topic] for topic, _ in plan.datagrams}
        key = "client deadman", plan, tuple(used.values())
        return opened.state.keep(key, lambda: self._client_deadmen.add(plan, program.counters, used))

    def subscriber_joined(self, topic: str) -> None:
        """Shortly after the start, have deadmen of the topic publish to a subscriber that was discovered."""
        if (now := self.now) is None:
            return
        for plan in now.program.client_deadmen:
            if topic in dict(plan.datagrams) and now.client_deadmen[plan.route].greet(boottime_ns()):
                what = "the deadman publishes its payload to a new subscriber, since the router starts"
                logger.info(what, route=plan.route, topic=topic)

    # running it

    def adopt(self, built: Built, left: Sequence[Listener] = ()) -> None:
        """Execute a program from now on; the first one starts the threads. Listeners that are `left` are emptied.

        Raises StuckError or StartError, with nothing changed. Until `has_passed`, threads may use the earlier program.
        """
        with ExitStack() as undo:
            for thread in self._from_ros:
                thread.leave(built.topics)
                undo.callback(thread.stay)
            self._change_topics(built)
            if self.now is None:
                self._carrier.start(built.native, _change_of_destinations(built))
                self._is_running = True
            undo.pop_all()
        if self.now is not None:
            for listener in left:
                listener.end_input()
            self._change(built, self.now)
        clients = self.now.client_deadmen if self.now else {}
        self._client_deadmen.adopt(clients, built.client_deadmen, built.native.generation)
        self._publishing.advance(built.native.generation)
        # After deadmen were replaced: a feed of the earlier ones acts on the next ones.
        for thread, other in zip(self._from_ros, reversed(self._from_ros), strict=True):
            thread.follow(other)
            thread.serve(built.topics)
        self.now = built

    def _change(self, built: Built, earlier: Built) -> None:
        """Have the receive thread execute another program; deadmen inherit the state of those that they replace."""
        before = earlier.deadmen
        replaced = [
            (each, before[route])
            for route, each in built.deadmen.items()
            if route in before and before[route] is not each
        ]
        for next_one, replaced_one in replaced:
            next_one.succeeds(replaced_one)
        pairs = [(next_one.address, each.address) for next_one, each in replaced]
        self._carrier.change(built.native, pairs, _change_of_destinations(built))

    def _change_topics(self, built: Built) -> None:
        """Post what changes in the timers of the publish thread, before it gets a message of this program."""
        adopted = [each for each in built.adopted if each.is_topic]
        left = [
            each.address
            for each in built.state.left()
            if isinstance(each, NativeCollector) or (isinstance(each, NativeDeferral) and each.is_topic)
        ]
        change = c.PublishChange(timers=timer_change(adopted, left), generation=built.native.generation)
        built.native.arrays.append(change)
        self._publishing.change(change)

    def has_passed(self) -> bool:
        """Wait until nothing of an earlier program is in use. Return False where that takes longer than a second."""
        if not self._is_running or self.now is None:
            return True
        generation = self.now.native.generation
        waits = {"publish": self._publishing.wait_for, "client deadmen": self._client_deadmen.wait_for}
        until = monotonic() + _PATIENCE_S
        late = [name for name, wait_for in waits.items() if not wait_for(generation, max(until - monotonic(), _TURN_S))]
        if late:
            logger.error("a thread is stuck, and what it uses stays open", threads=late)
            return False
        return self._has_turned() and all(thread.has_passed for thread in self._from_ros)

    def _has_turned(self) -> bool:
        """Wait until the receive thread is done with what it now handles: it may be dropping an earlier message."""
        turns = self._carrier.turns
        for _ in range(int(_PATIENCE_S / _TURN_S)):
            if self._carrier.turns != turns:
                return True
            sleep(_TURN_S)
        return False

    def end(self, earlier: Built) -> None:
        """End the deadmen that only an earlier program had, once no thread feeds them any more: they send if armed."""
        kept = self.now.deadmen.values() if self.now else ()
        for deadman in earlier.deadmen.values():
            if deadman not in kept:
                deadman.end()

    def observe(self, *, is_observed: bool) -> None:
        """Begin or cease to show received datagrams to the mirror."""
        lost = self._counters.counters.index("mirror_dropped")
        self._carrier.mirror(self._mirrored.ring if is_observed else None, lost)

    def feed_watchdog(self, notify: int, interval: int) -> None:
        """Feed a watchdog by a connected socket, every `interval` ns; -1 for none."""
        self._carrier.watchdog(notify, interval)

    # the end

    def stop(self, listeners: Sequence[Listener]) -> bool:
        """End all input, serve what the kernel holds and what waits, and end the threads; deadmen go on.

        What is in an inherited socket stays there, for the next process. Return False if a thread is stuck in the
        middleware: then subscriptions and publishers have to stay open.
        """
        for listener in listeners:
            listener.end_input()
        self._carrier.stop_receiving()
        self._is_running = False
        have_ended = [self._publishing.stop(), *(thread.stop() for thread in self._from_ros)]
        self.has_stopped = True
        return all(have_ended)

    def close(self) -> bool:
        """Send what waits, then have deadmen send a last time. Nothing is sent afterwards.

        Return False if the thread of clients' deadmen is stuck in the middleware: then publishers have to stay open.
        """
        self._deadmen.end()
        has_ended = self._client_deadmen.stop()
        if not has_ended:
            logger.error("a thread is stuck, and the router ends without it", threads=["client deadmen"])
        if self.has_stopped:  # else `stop` is stuck, and its threads use what would be freed
            self._events.close()
            self._carrier.close()
        return has_ended

    # for events

    def _why_rejected(self, listener: str, data: bytes, length: int) -> str:
        return why_rejected(self.now.program, listener, data, length) if self.now else ""

    def _where_refused(self, route: str, topic: str | None, target: str, generation: int, place: int) -> str:
        """Nothing if the message was not refused by the program that runs."""
        if self.now is None or self.now.native.generation != generation:
            return ""
        return where_refused(self.now.program.lowered, route, topic, target, place)


def _change_of_destinations(built: Built) -> c.TimerChange:
    """What changes in the timers of endpoints. What only the earlier program had sends what it holds."""
    left = list(built.state.left())
    ended = [each.address for each in left if isinstance(each, NativePacer)]
    ended += [each.address for each in left if isinstance(each, NativeDeferral) and not each.is_topic]
    return timer_change([each for each in built.adopted if not each.is_topic], ended)


def _limit(state: State, plan: RoutePlan, target: TargetPlan) -> c.Limit:
    """The limit of a target with `max_rate`, which lives as long as programs have the target."""
    rate = target.max_rate
    assert rate is not None  # noqa: S101 - asked for by the caller
    return state.keep(("limit", plan.route, plan.topic, target), lambda: open_limit(rate))


def log_start(route: str, sent_to: Sequence[str]) -> None:
    if sent_to:
        logger.info("the deadman has sent its payload, since the router starts", route=route, to=list(sent_to))

"""The native threads, and the program that they execute.

`build` makes arrays from a compiled program and its open sockets and topics; `adopt` switches each thread to them
between two messages. Messages received before are handled by the earlier program. State that lasts from one message to
the next is passed on by key.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from time import monotonic, sleep

from router import declared as c
from router.app.counts import ThreadCounts
from router.carrier.boards import NativeBoards
from router.carrier.client_deadmen import ClientDeadman, ClientDeadmen, await_receipt
from router.carrier.deadmen import NativeDeadman, replaced, successors
from router.carrier.deferrals import Adoption, timer_change
from router.carrier.events import DeadmanEvents, EventReader, EventThread
from router.carrier.forwarding import KEPT_GENERATION, Forwarding, counts_and_events
from router.carrier.from_ros import FromRosThread
from router.carrier.mirror import ActionRing, MirrorRing
from router.carrier.outlets import AwaitedPublication, Outlets
from router.carrier.program import NativeProgram, change_to, native_program
from router.carrier.publishing import PublishThread
from router.carrier.reasons import superseded, where_refused, why_rejected
from router.carrier.ros_routes import NativeFromRos, Subscription, native_from_ros
from router.carrier.sender import NativeSender
from router.carrier.state import State
from router.clock import boottime_ns
from router.compiler.program import Program
from router.datagrams import Peer
from router.errors import ConfigurationError
from router.kept.head_start import HeadStart
from router.log import logger
from router.net.udp import Listener
from router.observe.reports import Reporter

_PATIENCE_S = 1.0
"""How long, in seconds, a reload waits for a thread that may be stuck in the middleware."""

_TURN_S = 0.002


@dataclass(frozen=True, slots=True)
class Opened:
    """The open sockets and topics of a program, and its state. Publications and subscriptions are by topic."""

    listeners: Mapping[str, Listener]
    senders: Mapping[str, NativeSender]
    publications: Mapping[str, AwaitedPublication]
    subscriptions: Mapping[str, Subscription]
    state: State


@dataclass(frozen=True, slots=True)
class Built:
    """A program as the threads execute it. `deadmen` are of routes, `client_deadmen` of gateway clients, by name.

    `adopted` are its deferrals, pacers and collectors.
    """

    program: Program
    state: State
    native: NativeProgram
    from_ros: NativeFromRos
    adopted: Sequence[Adoption]
    deadmen: Mapping[str, NativeDeadman]
    client_deadmen: Mapping[str, ClientDeadman]

    def timers(self, earlier: Built | None, *, of_topics: bool) -> c.TimerChange:
        """Return changes to the timers of topics or endpoints. Timers only in `earlier` deliver what they hold."""
        now, before = (
            [each for each in adopted if each.is_topic is of_topics]
            for adopted in (self.adopted, earlier.adopted if earlier else ())
        )
        return timer_change(now, before)


class Plane:
    """Receives, forwards, publishes and brakes. `of_deadmen` gets the events of deadmen."""

    def __init__(
        self,
        forwarding: Forwarding,
        counts: ThreadCounts,
        reporter: Reporter,
        of_deadmen: Callable[[DeadmanEvents], None],
        first: Program,
        head_start: HeadStart | None = None,
    ) -> None:
        self.now: Built | None = None
        """The running program; None before the first one, also during a head start."""
        self.library = library = forwarding.library
        self.counts = counts
        self._head_start = head_start
        self._forwarding, self._names = forwarding, forwarding.names
        self._deadmen, self._carrier = forwarding.deadmen, forwarding.carrier
        self._generations = count(KEPT_GENERATION + 1)
        self._programs = {KEPT_GENERATION: first} if head_start is not None else {}
        """Programs that explain events, by generation; the newest one is last."""
        self._is_running = head_start is not None
        self.has_stopped = self._has_stopped_ros = False
        size = counts.counters.size
        self._client_deadmen = ClientDeadmen(library, *counts_and_events(library, size), self._names)
        self._publishing = PublishThread(library, forwarding.published, *counts_and_events(library, size), self._names)
        self._from_ros = [
            FromRosThread(library, self._deadmen.address, *counts_and_events(library, size), is_urgent=is_urgent)
            for is_urgent in (True, False)
        ]
        # Copy the publish thread's counts before the receive thread's, so that `messages_waiting` is never negative.
        threads = self._deadmen, self._client_deadmen, self._publishing, self._carrier, *self._from_ros
        for thread in threads:
            counts.add_thread(thread)
        self._mirrored = MirrorRing(forwarding.mirrored, self._names)
        self._acted = ActionRing(forwarding.acted, self._names)
        reader = EventReader(self._names, self._why_rejected, self._superseded, self._where_refused)
        self._events = EventThread(threads, reader, reporter.report, of_deadmen, reporter.returned, self._pulse)

    @property
    def turns(self) -> int:
        """A number that grows unless the receive thread is stuck, even without traffic."""
        return self._carrier.turns

    def stalled(self) -> Iterator[tuple[str, float]]:
        """Return the topics on which native threads are publishing now, each with the seconds since the call began."""
        return filter(None, (self._publishing.stalled(), self._client_deadmen.stalled()))

    def start_reporting(self) -> None:
        """Start to report events, and to signal that Python is alive. All receivers of events must be complete."""
        self._events.start()

    def _pulse(self) -> None:
        self._carrier.pulse()
        for thread in self._from_ros:
            thread.report_failures()

    # building a program

    def first_state(self) -> State:
        """Return the state of the first program, which includes what a head start has opened."""
        return State(self.library, opened=self._head_start.opened if self._head_start else None)

    def start_deadmen(self, program: Program, senders: Mapping[str, NativeSender], state: State) -> None:
        """Have deadmen send at the start of the router, unless they did so in a head start.

        This needs only sockets, so it does not wait for ROS, which takes longer to open.
        """
        for plan in program.deadmen:
            deadman = self._deadmen.get_or_open(plan, program.counters, senders, state)
            sent_to = self._head_start.sent[plan.route] if self._head_start else deadman.start(boottime_ns())
            if sent_to:
                what = "the deadman has sent its payload at startup"
                logger.info(what, route=plan.route, to=sent_to)

    def build(self, program: Program, opened: Opened) -> Built:
        """Make the arrays of a program. Raises StartError."""
        counters, state = program.counters, opened.state
        outlets = Outlets.of(
            program,
            self._deadmen,
            state,
            listeners=opened.listeners,
            senders=opened.senders,
            publications=opened.publications,
            boards=NativeBoards(program.boards),
        )
        generation = next(self._generations)
        native = native_program(program, generation, outlets)
        from_ros = native_from_ros(program, generation, outlets, opened.subscriptions)
        for arrays in (native.arrays, from_ros.arrays):
            arrays.keep(outlets)
        adopted = [*outlets.pacers(), *native.states.adopted, *from_ros.states.adopted]
        clients = {
            plan.route: self._client_deadmen.get_or_open(plan, counters, opened.publications, state)
            for plan in program.client_deadmen
        }
        if self._head_start is not None and self.now is None:
            for topic, publication in opened.publications.items():
                self._head_start.bind_topic(topic, publication.address)
        self._start_threads(program, from_ros, clients)
        return Built(program, state, native, from_ros, adopted, outlets.deadmen, clients)

    def _start_threads(self, program: Program, from_ros: NativeFromRos, clients: Mapping[str, ClientDeadman]) -> None:
        """Start the threads that the program needs. Raises StartError.

        Deadmen of clients are served from now on: clients may publish before the program runs.
        """
        if program.publishers:
            first = self._head_start.topics if self._head_start is not None else None
            self._publishing.start(_functions_of_rcl(self.library), first)
        for thread in self._from_ros:
            if from_ros.only(urgent=thread.is_urgent).topics:
                from router.ros.receiving import RESET, TAKE  # rclpy is loaded: the topics are open

                thread.start(TAKE, RESET)
        if clients:
            self._client_deadmen.start(_functions_of_rcl(self.library))
        if self.now is None:
            for deadman in clients.values():
                deadman.await_subscribers(boottime_ns())

    def subscriber_joined(self, topic: str) -> None:
        """Shortly after the start, have deadmen of the topic publish to a newly discovered subscriber."""
        if (now := self.now) is None:
            return
        for plan in now.program.client_deadmen:
            if topic in dict(plan.datagrams) and now.client_deadmen[plan.route].greet(boottime_ns()):
                what = "the deadman publishes its payload to a new subscriber after startup"
                logger.info(what, route=plan.route, topic=topic)

    # running a program

    def adopt(self, built: Built, unused: Sequence[Listener] = ()) -> None:
        """Switch to a program; the first one starts the threads. `unused` listeners are drained and closed to input.

        Raises StuckError or StartError with nothing changed. Threads may use the earlier program until
        `wait_until_adopted` returns True.
        """
        earlier, generation = self.now, built.native.generation
        with ExitStack() as undo:
            for thread in self._from_ros:
                thread.hand_over(built.from_ros)
                undo.callback(thread.take_back)
            # Before the publish thread receives a message of this program.
            topics = c.PublishChange(timers=built.timers(earlier, of_topics=True), generation=generation)
            built.native.arrays.keep(topics)
            self._publishing.change(topics)
            if not self._is_running:
                self._carrier.start(change_to(built.native, built.timers(None, of_topics=False)), built.native)
                self._is_running = True
            undo.pop_all()
        if earlier is None:
            if self._head_start is not None:  # it has the same state: no timer ends, and no deadman is replaced
                self._carrier.change(change_to(built.native, built.timers(None, of_topics=False)), built.native)
        else:
            for listener in unused:
                listener.end_input()
            routes = successors(built.program.deadmen, earlier.program.deadmen)
            deadmen = replaced(built.deadmen, earlier.deadmen, routes)
            change = change_to(built.native, built.timers(earlier, of_topics=False), deadmen)
            self._carrier.change(change, built.native)
        self._publishing.advance(generation)
        # Before the threads that may carry the last messages of deadmen to boards.
        self._client_deadmen.adopt(earlier.client_deadmen if earlier else {}, built.client_deadmen, generation)
        # After deadmen were replaced: feeding an earlier one now feeds its replacement.
        for thread, other in zip(self._from_ros, reversed(self._from_ros), strict=True):
            thread.follow(other)
            thread.adopt(built.from_ros)
        self.now = built
        self._programs = {**(self._programs if earlier is None else {}), generation: built.program}

    def wait_until_adopted(self) -> bool:
        """Wait until nothing of an earlier program is in use. Return False if that takes longer than a second."""
        if not self._is_running or self.now is None:
            return True
        generation = self.now.native.generation
        waits = {"publish": self._publishing.wait_for, "client deadmen": self._client_deadmen.wait_for}
        until = monotonic() + _PATIENCE_S
        late = [name for name, wait_for in waits.items() if not wait_for(generation, max(until - monotonic(), _TURN_S))]
        if late:
            logger.error("thread did not leave the old program in time; its sockets and topics stay open", threads=late)
            return False
        if not self._wait_for_turn() or not all(thread.has_adopted for thread in self._from_ros):
            return False
        self._head_start = None
        return True

    def _wait_for_turn(self) -> bool:
        """Wait until the receive thread has finished its present turn, in which it may drop an earlier message."""
        turns = self._carrier.turns
        for _ in range(int(_PATIENCE_S / _TURN_S)):
            if self._carrier.turns != turns:
                return True
            sleep(_TURN_S)
        return False

    def end(self, earlier: Built) -> None:
        """End the deadmen that only an earlier program had, once no thread feeds them; armed ones send."""
        kept = self.now.deadmen.values() if self.now else ()
        for deadman in earlier.deadmen.values():
            if deadman not in kept:
                deadman.end()

    # received datagrams and actions, for the mirror

    def observe(self, *, is_observed: bool) -> None:
        """Start or stop mirroring received datagrams for `take`, and actions for `take_actions`."""
        lost = self.counts.counters.index("mirror_dropped") if is_observed else None
        self._forwarding.mirror(lost, self._client_deadmen.group)

    def take(self) -> list[tuple[int, str, Peer, str, str, bytes]]:
        """Return the datagrams received since the last call, as `recording.mirror.Mirrored`. Not thread-safe."""
        return self._mirrored.take()

    def take_actions(self) -> list[tuple[int, str, str, str, str, str, str, bytes]]:
        """Return the actions since the last call, as fields of `recording.mirror.Action`. Not thread-safe."""
        return self._acted.take()

    @property
    def lost(self) -> int:
        """Datagrams and actions that the full mirror dropped."""
        return self.counts.total("mirror_dropped")

    def feed_watchdog(self, notify: int, interval: int) -> None:
        """Feed a watchdog through the connected socket `notify` every `interval` ns; -1 ends that."""
        self._carrier.watchdog(notify, interval)

    # stopping

    def stop(self, listeners: Sequence[Listener]) -> bool:
        """End all listeners, and handle what has arrived there; messages from ROS are still routed.

        Datagrams in an inherited socket stay there for the next process. Return False if a thread is stuck in the
        middleware: then publishers must stay open.
        """
        for listener in listeners:
            listener.end_input()
        self._carrier.stop_receiving()
        self._is_running = False
        has_ended = _stop([self._publishing])
        self.has_stopped = True
        return has_ended

    def end_client_deadmen(self) -> bool:
        """Have deadmen of clients publish a last time, and wait, but not long, until subscriptions have received that.

        Return False if their thread is stuck in the middleware: then publishers must stay open.
        """
        has_ended = _stop([self._client_deadmen])
        if has_ended and self.now is not None:
            await_receipt(self.now.client_deadmen.values())
        return has_ended

    def stop_ros(self) -> bool:
        """Route the messages from ROS that have arrived, and end their threads; deadmen of routes keep running.

        Return False if a thread is stuck in the middleware: then subscriptions must stay open.
        """
        has_ended = _stop(self._from_ros)
        self._has_stopped_ros = True
        return has_ended

    def close(self) -> None:
        """Send what is held back, then have deadmen of routes send a last time. Nothing is sent afterwards."""
        self._deadmen.end()
        if self.has_stopped and self._has_stopped_ros:  # else their threads use what would be freed
            self._events.close()
            self._carrier.close()

    # explaining events

    def _why_rejected(self, listener: str, data: bytes, length: int) -> str:
        newest = next(reversed(self._programs.values()), None)
        return why_rejected(newest, listener, data, length) if newest is not None else ""

    def _superseded(self, listener: str, data: bytes) -> str:
        newest = next(reversed(self._programs.values()), None)
        return superseded(newest, listener, data) if newest is not None else ""

    def _where_refused(self, route: str, topic: str | None, target: str, generation: int, place: int) -> str:
        """Return the place in the table; "" if an earlier program refused the message."""
        program = self._programs.get(generation)
        return where_refused(program.lowered, route, topic, target, place) if program is not None else ""


def _stop(threads: Sequence[PublishThread | FromRosThread | ClientDeadmen]) -> bool:
    """Stop threads. Log those that are stuck in the middleware; return whether there are none."""
    stuck = [thread.name for thread in threads if not thread.stop()]
    if stuck:
        logger.error("thread did not stop in time; the router exits without it", threads=stuck)
    return not stuck


def _functions_of_rcl(library: ctypes.CDLL) -> tuple[int, int, int]:
    """Return the addresses of rcl's functions to publish, to get its error, and to reset that.

    Raises ConfigurationError.
    """
    from router.ros.rcl import publish_functions  # rclpy is loaded: the topics are open

    functions = None if library.rcl_types_differ() else publish_functions()
    if functions is None:
        raise ConfigurationError(
            "the struct layout of rcl differs from what the carrier expects",
            "run the router with ROS 2 Jazzy, and run 'make setup' after each upgrade of ROS",
        )
    return functions

"""The native threads, and the image that they execute.

An image is written and loaded first (`Images`), so that its deadmen can send before ROS is open; `Plane` switches each
thread to it between two messages. Messages received before are handled by the earlier image. State that lasts from one
message to the next is passed on by key.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from time import monotonic, sleep

from router.app.change import Change
from router.app.counts import ThreadCounts
from router.carrier.client_deadmen import ClientDeadmen, await_receipt
from router.carrier.events import DeadmanEvents, EventReader, EventThread, Reply, StateChange, content_of
from router.carrier.forwarding import FIRST_GENERATION, Forwarding, counts_and_events
from router.carrier.from_ros import FromRosThread
from router.carrier.loading import LoadedImage
from router.carrier.mirror import ActionRing, MirrorRing, Taken
from router.carrier.publishing import PublishThread
from router.carrier.reasons import superseded, where_refused, why_rejected
from router.carrier.requests import RequestSender
from router.carrier.ros_routes import RosRoutes
from router.clock import boottime_ns
from router.compiler.compiled_table import CompiledTable
from router.datagrams import Peer
from router.errors import ConfigurationError
from router.image.writer import write_image
from router.log import logger
from router.net.udp import Listener
from router.observe.reports import Reporter
from router.startup_image.head_start import HeadStart

_PATIENCE_S = 1.0
"""How long, in seconds, a reload waits for a thread that may be stuck in the middleware."""

_TURN_S = 0.002


@dataclass(frozen=True, slots=True)
class Running:
    """A program as the threads execute it."""

    program: CompiledTable
    image: LoadedImage


class Images:
    """Writes and loads the images of programs."""

    def __init__(self, forwarding: Forwarding, head_start: HeadStart | None) -> None:
        self._forwarding = forwarding
        self._sent = head_start.sent if head_start is not None else {}
        self._generations = count(FIRST_GENERATION + 1)

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Load the image. Deadmen of the first program send, unless they did so in a head start.

        This needs only sockets, so it does not wait for ROS, which takes longer to open. Raises MemoryError.
        """
        assert change.sockets is not None  # noqa: S101 - prepared
        image = write_image(change.program, self._forwarding.names)
        change.image = self._forwarding.load(image, change.sockets.senders, next(self._generations), change.before)
        change.image.bind_listeners(change.sockets.listeners)
        if change.is_first:
            has_sent = [*change.before.deadmen.values()] if change.before is not None else []
            change.is_same = change.before.image == image if change.before is not None else None
            for route, deadman in change.image.deadmen.items():
                sent = self._sent.get(route) if deadman in has_sent else deadman.start(boottime_ns())
                if sent:
                    logger.info("the deadman has sent its payload at startup", route=route, to=sent)

    def finish(self, change: Change) -> None:
        """End the deadmen that only the earlier image had, and free what only it used; armed deadmen send."""
        if change.before is not None and change.image is not None:
            kept = [*change.image.deadmen.values()]
            for deadman in change.before.deadmen.values():
                if deadman not in kept:
                    deadman.end()
        change.before = None
        if change.image is not None:
            change.image.forget_before()


class Plane:
    """Receives, forwards, publishes and brakes. `of_deadmen` gets the events of deadmen."""

    def __init__(
        self,
        forwarding: Forwarding,
        counts: ThreadCounts,
        reporter: Reporter,
        of_deadmen: Callable[[DeadmanEvents], None],
        first: CompiledTable,
        head_start: LoadedImage | None = None,
    ) -> None:
        self.now: Running | None = None
        """The running program; None before the first one, also during a head start."""
        self.library = library = forwarding.library
        self.counts = counts
        self._head_start = head_start
        self._forwarding, self._names = forwarding, forwarding.names
        self._deadmen, self._threads = forwarding.deadmen, forwarding.threads
        self._programs = {FIRST_GENERATION: first} if head_start is not None else {}
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
        self.requests = RequestSender(library, self._deadmen.address, *counts_and_events(library, size))
        self.replied: Callable[[Reply], None] = lambda _: None
        """Gets the replies for services."""
        # Copy the publish thread's counts before the receive thread's, so that `messages_waiting` is never negative.
        threads = self._deadmen, self._client_deadmen, self._publishing, self._threads, *self._from_ros, self.requests
        for thread in threads:
            counts.add_thread(thread)
        self._mirrored = MirrorRing(forwarding.mirrored, self._names)
        self._acted = ActionRing(forwarding.acted, self._names)
        reader = EventReader(self._names, self._why_rejected, self._superseded, self._where_refused)
        self._events = EventThread(
            threads,
            reader,
            reporter.report,
            of_deadmen,
            reporter.returned,
            reporter.learned,
            reporter.link_changed,
            self._state_changed,
            self._take_reply,
            self._pulse,
        )

    @property
    def image(self) -> LoadedImage | None:
        """The image that the threads execute."""
        return self.now.image if self.now is not None else self._head_start

    @property
    def turns(self) -> int:
        """A number that grows unless the receive thread is stuck, even without traffic."""
        return self._threads.turns

    def stalled(self) -> Iterator[tuple[str, float]]:
        """Return the topics on which native threads are publishing now, each with the seconds since the call began."""
        return filter(None, (self._publishing.stalled(), self._client_deadmen.stalled()))

    def state_texts(self) -> Iterator[tuple[tuple[str, str], int]]:
        """Yield the name and the present value of each state that is a text, with 1."""
        if (now := self.now) is not None:
            for state, content in zip(now.program.states, now.image.states(boottime_ns()), strict=False):
                if state.is_text:
                    yield (state.name, str(content_of(content, state.is_text))), 1

    def start_reporting(self) -> None:
        """Start to report events, and to signal that Python is alive. All receivers of events must be complete."""
        self._events.start()

    def _pulse(self) -> None:
        self._threads.pulse()
        for thread in self._from_ros:
            thread.report_failures()

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Bind the image to its topics, and start the threads that it needs. Raises StartError.

        Deadmen of clients are served from now on: clients may publish before the program runs.
        """
        image = change.image
        assert image is not None  # noqa: S101 - prepared
        publications = change.ros.publications if change.ros else {}
        subscriptions = change.ros.subscriptions if change.ros else {}
        image.bind_topics(publications)
        image.open_client_deadmen(self._client_deadmen.group)
        change.routes = RosRoutes.of(image, {topic: each.raw for topic, each in subscriptions.items()})
        waiting = None
        if change.is_first and change.before is not None:
            change.before.bind_topics(publications)  # messages of the head start may be waiting
            waiting = change.before.topic_change()
        if change.is_same is False:
            self._programs = {}  # they would not explain its events
        if change.program.publishers or change.program.service_names:
            self._publishing.start(_functions_of_rcl(self.library), waiting)
        for thread in self._from_ros:
            if change.routes.only(urgent=thread.is_urgent).topics:
                from router.ros.receiving import RESET, TAKE  # rclpy is loaded: the topics are open

                thread.start(TAKE, RESET)
        if image.client_deadmen:
            self._client_deadmen.start(_functions_of_rcl(self.library))
        if change.is_first:
            for deadman in image.client_deadmen.values():
                deadman.await_subscribers(boottime_ns())

    def adopt(self, change: Change) -> None:
        """Switch to the image; the first one starts the threads. Listeners that it lacks are drained.

        Raises StuckError or StartError with nothing changed. Threads may use the earlier image until
        `wait_until_adopted` returns True.
        """
        image, routes, before, sockets = change.image, change.routes, change.before, change.sockets
        assert image is not None  # noqa: S101 - prepared
        assert routes is not None  # noqa: S101 - prepared
        assert sockets is not None  # noqa: S101 - prepared
        explained = self._programs
        self._programs = {**explained, image.generation: change.program}  # events of its threads come at once
        with ExitStack() as undo:
            undo.callback(setattr, self, "_programs", explained)
            for thread in self._from_ros:
                thread.hand_over(routes)
                undo.callback(thread.take_back)
            # Before the publish thread receives a message of this image.
            self._publishing.change(image.topic_change(before))
            if not self._is_running:
                self._threads.start(image.change(), image)
                self._is_running = True
            undo.pop_all()
        if before is not None:
            for listener in sockets.left:
                listener.end_input()
            self._threads.change(image.change(before), image)
        self._publishing.advance(image.generation)
        # Before the threads that may carry the last messages of deadmen to boards.
        earlier = before.client_deadmen if before is not None else {}
        self._client_deadmen.adopt(earlier, image.client_deadmen, image.generation)
        # After deadmen were replaced: feeding an earlier one now feeds its replacement.
        for thread, other in zip(self._from_ros, reversed(self._from_ros), strict=True):
            thread.follow(other)
            thread.adopt(routes)
        self.now, self._head_start = Running(change.program, image), None
        if not change.is_first:
            self._programs = {image.generation: change.program}

    def wait_until_adopted(self) -> bool:
        """Wait until nothing of an earlier image is in use. Return False if that takes longer than a second."""
        if not self._is_running or self.now is None:
            return True
        generation = self.now.image.generation
        waits = {"publish": self._publishing.wait_for, "client deadmen": self._client_deadmen.wait_for}
        until = monotonic() + _PATIENCE_S
        late = [name for name, wait_for in waits.items() if not wait_for(generation, max(until - monotonic(), _TURN_S))]
        if late:
            logger.error("thread did not leave the old program in time; its sockets and topics stay open", threads=late)
            return False
        return self._wait_for_turn() and all(thread.has_adopted for thread in self._from_ros)

    def _wait_for_turn(self) -> bool:
        """Wait until the receive thread has finished its present turn, in which it may drop an earlier message."""
        turns = self._threads.turns
        for _ in range(int(_PATIENCE_S / _TURN_S)):
            if self._threads.turns != turns:
                return True
            sleep(_TURN_S)
        return False

    def subscriber_joined(self, topic: str) -> None:
        """Shortly after the start, have deadmen of the topic publish to a newly discovered subscriber."""
        if (now := self.now) is None:
            return
        for plan in now.program.client_deadmen:
            if topic in dict(plan.datagrams) and now.image.client_deadmen[plan.route].greet(boottime_ns()):
                what = "the deadman publishes its payload to a new subscriber after startup"
                logger.info(what, route=plan.route, topic=topic)

    # received datagrams and actions, for the mirror

    def observe(self, *, is_observed: bool) -> None:
        """Start or stop mirroring received datagrams for `take`, and actions for `take_actions`."""
        lost = self.counts.counters.index("mirror_dropped") if is_observed else None
        self._forwarding.mirror(lost, self._client_deadmen.group)

    def take(self) -> Taken[tuple[int, str, Peer, str, str, bytes]]:
        """Return the datagrams received since the last call, as `recording.mirror.Mirrored`. Not thread-safe."""
        return self._mirrored.take()

    def take_actions(self) -> Taken[tuple[int, str, str, str, str, str, str, bytes]]:
        """Return the actions since the last call, as fields of `recording.mirror.Action`. Not thread-safe."""
        return self._acted.take()

    @property
    def lost(self) -> int:
        """Datagrams and actions that the full mirror dropped."""
        return self.counts.total("mirror_dropped")

    def feed_watchdog(self, notify: int, interval: int) -> None:
        """Feed a watchdog through the connected socket `notify` every `interval` ns; -1 ends that."""
        self._threads.watchdog(notify, interval)

    # stopping

    def stop(self, listeners: Mapping[str, Listener]) -> bool:
        """End all listeners, and handle what has arrived there; messages from ROS are still routed.

        Datagrams in an inherited socket stay there for the next process. Return False if a thread is stuck in the
        middleware: then publishers must stay open.
        """
        for listener in listeners.values():
            listener.end_input()
        self._threads.stop_receiving()
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
            await_receipt(self.now.image.client_deadmen.values())
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
            if self.image is not None:
                self.image.stop_links()
            self._events.close()
            self._threads.close()

    # explaining events

    def _why_rejected(self, listener: str, reason: int, data: bytes, length: int) -> str:
        newest = next(reversed(self._programs.values()), None)
        return why_rejected(newest, listener, reason, data, length) if newest is not None else ""

    def _superseded(self, listener: str, data: bytes) -> str:
        newest = next(reversed(self._programs.values()), None)
        return superseded(newest, listener, data) if newest is not None else ""

    def _state_changed(self, change: StateChange) -> None:
        """Log a change in the words of the newest table that has the state."""
        programs = reversed(self._programs.values())
        plan = next((state for each in programs for state in each.states if state.name == change.state), None)
        before, after = (plan.shown(value) if plan else str(value) for value in (change.before, change.after))
        if change.source is not None:
            logger.info("state changed", state=change.state, before=before, after=after, source=change.source)
        else:
            logger.warning("state is back at its initial value", state=change.state, before=before, after=after)

    def _take_reply(self, reply: Reply) -> None:
        self.replied(reply)

    def _where_refused(self, route: str, topic: str | None, target: str, generation: int, place: int) -> str:
        """Return the place in the table; "" if an earlier program refused the message."""
        program = self._programs.get(generation)
        return where_refused(program, route, topic, target, place) if program is not None else ""


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

"""Everything that is open for the running program, and how another program takes over.

A takeover has three steps: prepare (open what the program needs in addition; may fail), swap (between two datagrams,
while all receiving threads are paused), finish (close what is no longer used). The first program starts the same way.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.app.sockets import KernelDrops, SocketChange, Sockets
from router.app.wiring import Datapath, RouterContext, Wiring
from router.carrier.library import load
from router.compiler.program import Program
from router.compiler.topics import DIAGNOSTICS, resolved
from router.errors import SourceSpan, StartError
from router.log import fault
from router.ros.environment import check_environment, ros_remedy
from router.threads import background_threads

if TYPE_CHECKING:
    from router.gateway.thread import GatewayChange, GatewayThread
    from router.ros.endpoints import RosChange
    from router.ros.router_node import RouterNode

_STALLED_S = 0.01
"""A call that publishes usually takes less."""


@dataclass(frozen=True, slots=True)
class Change:
    """A prepared program. `undo` closes what was opened for it."""

    sockets: SocketChange
    topics: RosChange | None
    wiring: Wiring
    gateways: GatewayChange | None
    undo: ExitStack


class Runtime:
    """The sockets, ROS node, gateways and threads of the running program."""

    def __init__(
        self, context: RouterContext, ros_args: Sequence[str], datapath: Callable[[Callable[[], bool]], Datapath]
    ) -> None:
        self.wiring: Wiring | None = None
        self.datapath = datapath(self._is_subscribed)
        self.drops = KernelDrops()
        self.sockets = Sockets(self.drops, self.datapath.open_listener, self.datapath.open_sender)
        self.gateways: GatewayThread | None = None
        self._context = context
        self._ros_args = ros_args
        self._ros: RouterNode | None = None
        self._unfinished: list[Callable[[], None]] = []

    @property
    def node_name(self) -> str:
        """The fully qualified name of the ROS node, or "" without one."""
        return self._ros.name if self._ros else ""

    def stalled(self) -> dict[str, float]:
        """For how many seconds a call that publishes on a topic has been in the middleware, by topic; 0 if in none."""
        stalled = dict.fromkeys((plan.label for plan in self.wiring.program.publishers) if self.wiring else (), 0.0)
        ros, native = self._ros, self.datapath.stalled()
        for topic, seconds in (*(ros.stalled() if ros else ()), *([native] if native else ())):
            if seconds >= _STALLED_S:
                stalled[topic] = max(seconds, stalled.get(topic, 0.0))
        return stalled

    def start(self, change: Change, closing: ExitStack) -> None:
        """Run the prepared program. `closing` stops receiving."""
        timers = self._context.timers
        timers.start()
        closing.callback(self._stop_ros)
        self._swap(change)
        with background_threads():
            self._finish(change, None)
        self.datapath.start()
        closing.callback(lambda: self.datapath.stop(list(self.sockets.listeners.values())))

    def close_with(self, closing: ExitStack) -> None:
        """Have `closing` close sockets and ROS, after the services that use them."""
        closing.callback(self.sockets.close_listeners)
        closing.callback(self.sockets.close_senders)
        closing.callback(self._close_ros)

    def end_with(self, closing: ExitStack) -> None:
        """Have `closing` stop gateways, then open frames, waiting messages and last deadmen, which send once more."""
        closing.callback(self.datapath.close)
        for thread in self._context.timers.threads:  # of deadmen last
            closing.callback(thread.stop)
        closing.callback(self._stop_gateways)

    def prepare(self, program: Program) -> Change:
        """Open what `program` needs and is not open yet. Raises StartError, with nothing changed.

        For the first program, deadmen send their payload of the start here: nothing is received yet, but gateways serve
        clients as soon as they are open.
        """
        if self._unfinished and self.wiring is not None and self.datapath.has_passed(self.wiring):
            self._close_unfinished()  # first: it may be opened again
        with ExitStack() as undo:
            if self._ros is None and _needs_ros(program):
                check_environment(os.environ)  # before deadmen send, as the start may fail here
                _check_ros_arguments(program, self._ros_args)
            sockets = self.sockets.prepare(program)
            undo.callback(sockets.opened.close)
            self._context.counts.make_room(program.counters)
            states = self.datapath.states(self.wiring)
            undo.callback(lambda: self._context.timers.release(states.added()))
            if self.wiring is None:
                self.datapath.start_deadmen(program, sockets, states)
            topics = self._prepare_topics(program, undo)
            wiring = self.datapath.wire(program, sockets, self._ros, topics, states)
            undo.callback(self.datapath.abandon, wiring)
            if self.wiring is None:
                wiring.start(self._context.timers)
            gateways = self._prepare_gateways(program, wiring, undo)
            return Change(sockets, topics, wiring, gateways, undo.pop_all())

    def take_over(self, change: Change) -> None:
        """Replace the running program by the prepared one, between two messages.

        Raises StuckError or StartError, with nothing changed. A failure after the swap is a bug, and logged.
        """
        earlier = self.wiring
        try:
            change.wiring.check_gateways(earlier, self._context.timers)
            if self.gateways is not None and change.gateways is not None:
                self.gateways.retire(change.gateways)
            self.datapath.between(change.wiring, lambda: self._swap(change))
        except BaseException:
            change.undo.close()
            raise
        try:
            self._finish(change, earlier)
        except Exception as error:  # noqa: BLE001 a bug, which is logged: the program runs all the same
            fault(error, "kept it from closing what it does not use").log()

    def _swap(self, change: Change) -> None:
        """Replace the program, while the thread of ROS is paused."""
        with self._ros.paused() if self._ros else nullcontext():
            if self._ros is not None and change.topics is not None:
                self._ros.apply(change.topics, change.wiring.take)  # first: it may still fail
            left = self.sockets.left(change.sockets)
            self.sockets.apply(change.sockets)
            self.datapath.adopt(change.wiring, self.wiring, left, list(change.sockets.listeners.values()))
            self.wiring = change.wiring

    def _finish(self, change: Change, earlier: Wiring | None) -> None:
        """Watch the peers of new topics, and close what only the earlier program used.

        If a thread is stuck there, as in the middleware, that stays open until it goes on. All of it is done even if
        one step raises.
        """
        change.undo.pop_all()  # discarded
        with ExitStack() as last_first:
            last_first.callback(self._close_passed, change, earlier)
            if self._ros is not None and change.topics is not None:
                self._ros.watch(change.topics)

    def _close_passed(self, change: Change, earlier: Wiring | None) -> None:
        """Close what all threads have passed, in this reload and in those before."""
        self._unfinished.append(lambda: self._close_left(change, earlier))
        with ExitStack() as last_first:
            if self.datapath.has_passed(change.wiring):
                last_first.callback(self._context.counts.replace, change.wiring.program.counters)
                last_first.callback(self._close_unfinished)
            else:
                last_first.callback(self._context.counts.adopt, change.wiring.program.counters)
            if self.gateways is not None and change.gateways is not None:
                last_first.callback(self.gateways.finish, change.gateways)
                last_first.callback(self._follow_drops, self.gateways, change.gateways)

    def _close_unfinished(self) -> None:
        """Close what was left at reloads, the newest first. Each is tried once."""
        with ExitStack() as last_first:
            for close in self._unfinished:
                last_first.callback(close)
            self._unfinished = []

    def _close_left(self, change: Change, earlier: Wiring | None) -> None:
        with ExitStack() as last_first:
            if earlier is not None:
                last_first.callback(earlier.free)
            last_first.callback(change.sockets.left.close)
            if self._ros is not None and change.topics is not None:
                last_first.callback(self._ros.finish, change.topics)
            last_first.callback(change.wiring.states.forget_previous)
            last_first.callback(change.wiring.settle_pacers, self._context.timers)

    def _prepare_topics(self, program: Program, undo: ExitStack) -> RosChange | None:
        if self._ros is None and not _needs_ros(program):
            return None
        if self._ros is None:
            self._ros = _open_ros(program, self._ros_args, self._incompatible, self._subscriber_joined)
            undo.callback(self._close_ros)
            self._ros.start({}, self._context.reporter.failed)
        change = self._ros.prepare(program.publishers, program.subscriptions, _topic_spans(program))
        undo.callback(self._ros.abandon, change)
        return change

    def _prepare_gateways(self, program: Program, wiring: Wiring, undo: ExitStack) -> GatewayChange | None:
        if self._ros is None or not (program.gateways or self.gateways):
            return None
        if self.gateways is None:
            from router.gateway.thread import GatewayThread  # asyncio and websockets take 0.1 s to import

            reporter, counts = self._context.reporter, self._context.counts.gateways
            self.gateways = GatewayThread(self._ros, load(), counts, reporter.report, reporter.failed)
            undo.callback(self._stop_gateways)
        change = self.gateways.prepare(program, wiring.feed)
        undo.callback(self.gateways.abandon, change)
        return change

    def _follow_drops(self, gateways: GatewayThread, change: GatewayChange) -> None:
        drops = self.drops
        for service in change.left:
            drops.leave(service.name)
        for service in change.opened:
            if service.name in gateways.kernel_drops:
                drops.follow(service.name, gateways.kernel_drops[service.name])

    def _incompatible(self, topic: str, policy: str, peers: int) -> None:
        """Count peers with an incompatible QoS policy, for each route and gateway that names the topic."""
        if self.wiring is None:
            return
        program = self.wiring.program
        for name in _users_of_topics(program).get(topic, ()):
            self._context.counts.events[program.counters.index("qos_incompatible", name, topic, policy)] = peers

    def _subscriber_joined(self, topic: str) -> None:
        if self.wiring is not None:
            self.wiring.subscriber_joined(topic, self._context.timers)

    def _is_subscribed(self) -> bool:
        """Whether a topic has subscribers."""
        return self._ros is not None and bool(self._ros.subscribed)

    def _stop_gateways(self) -> None:
        if self.gateways is not None:
            self.gateways.stop()
            self.gateways = None

    def _stop_ros(self) -> None:
        if self._ros is not None:
            self._ros.stop_receiving()

    def _close_ros(self) -> None:
        if self._ros is not None:
            self._ros.close()
            self._ros = None


def _needs_ros(program: Program) -> bool:
    return bool(program.publishers or program.subscriptions or program.gateways)


def _check_ros_arguments(program: Program, ros_args: Sequence[str]) -> None:
    """Raises StartError. Without arguments ROS is not loaded for it, which takes a while."""
    if len(ros_args) > 1:
        try:
            from router.ros.node import check_arguments
        except ImportError as error:
            raise _missing_ros(program, error) from error
        check_arguments(ros_args)


def _open_ros(
    program: Program,
    ros_args: Sequence[str],
    incompatible: Callable[[str, str, int], None],
    subscriber_joined: Callable[[str], None],
) -> RouterNode:
    """Open a node without any topic. Raises StartError."""
    try:
        from router.ros.router_node import RouterNode
    except ImportError as error:
        raise _missing_ros(program, error) from error
    return RouterNode(program.table.node, (), (), {}, ros_args, incompatible, subscriber_joined)


def _missing_ros(program: Program, error: ImportError) -> StartError:
    return StartError(f"{program.table.path} has topics, and ROS 2 cannot be loaded: {error}", ros_remedy())


def _topic_spans(program: Program) -> Mapping[str, SourceSpan]:
    """The position in the table of each topic, by ROS name."""
    table = program.table
    spans = {topic.topic.value: topic.topic.span for route in table.routes for topic in route.all_topics}
    for gateway in table.gateways.values():
        for inbound in gateway.inbound:
            spans[resolved(inbound.topic.topic.value, table.node)] = inbound.topic.topic.span
    if table.node.diagnostics is not None:
        spans[DIAGNOSTICS] = table.node.diagnostics
    return spans


def _users_of_topics(program: Program) -> Mapping[str, Sequence[str]]:
    """The routes and gateways that name each topic, by ROS name."""
    names: dict[str, list[str]] = {}
    for route in program.table.routes:
        for topic in route.all_topics:
            names.setdefault(topic.topic.value, []).append(route.name)
    for gateway in program.gateways:
        for name in gateway.inbound:
            names.setdefault(name, []).append(gateway.settings.name)
    return names

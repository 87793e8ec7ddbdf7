"""The open sockets, topics and gateways of the running program, and the change to another program.

A reload has three steps: prepare (open what the program needs in addition; may fail), adopt (each thread changes to it
between two messages), finish (close what is no longer used). The first program starts the same way.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from router.app.plane import Built, Opened, Plane
from router.app.sockets import KernelDrops, SocketChange, Sockets
from router.carrier.state import State
from router.compiler.extras import missing_extras
from router.compiler.metrics import PUBLISHER, SHARES_NODE, SHARES_TOPIC, SUBSCRIBER
from router.compiler.program import Program
from router.compiler.topics import DIAGNOSTICS, resolved
from router.errors import ConfigurationError, SourceSpan, StartError
from router.log import fault, logger
from router.net.dds import clashes, discovers_by_multicast
from router.net.kernel import BELOW_ROS
from router.observe.reports import Reporter
from router.ros.environment import check_environment, ros_remedy
from router.shortage import is_shortage
from router.threads import background_threads

if TYPE_CHECKING:
    from router.gateway.thread import GatewayChange, GatewayThread
    from router.ros.endpoints import RosChange
    from router.ros.router_node import RouterNode

_STALLED_S = 0.01
"""Threshold in seconds: publish calls that have taken less are reported as 0."""


@dataclass(frozen=True, slots=True)
class Change:
    """A prepared program. `undo` closes what was opened for it."""

    sockets: SocketChange
    ros: RosChange | None
    built: Built
    gateways: GatewayChange | None
    undo: ExitStack

    @property
    def program(self) -> Program:
        return self.built.program


class Runtime:
    """The sockets, ROS node, gateways and threads of the running program."""

    def __init__(self, plane: Plane, reporter: Reporter, ros_args: Sequence[str]) -> None:
        self.plane = plane
        self.drops = KernelDrops()
        self.sockets = Sockets(self.drops, plane.library)
        self.gateways: GatewayThread | None = None
        self.refused: Counter[str] = Counter()
        self._counts = plane.counts
        self._reporter = reporter
        self._ros_args = ros_args
        self._ros: RouterNode | None = None
        self._unfinished: list[Callable[[], None]] = []

    @property
    def program(self) -> Program | None:
        """The running program."""
        return self.plane.now.program if self.plane.now else None

    @property
    def node_name(self) -> str:
        """The fully qualified name of the ROS node, or "" without one."""
        return self._ros.name if self._ros else ""

    def stalled(self) -> dict[str, float]:
        """Return the seconds for which a publish call has been in the middleware, by topic; 0 if no call is running."""
        stalled = dict.fromkeys((plan.label for plan in self.program.publishers) if self.program else (), 0.0)
        for topic, seconds in (*(self._ros.stalled() if self._ros else ()), *self.plane.stalled()):
            if seconds >= _STALLED_S:
                stalled[topic] = max(seconds, stalled.get(topic, 0.0))
        return stalled

    def subscribers(self) -> Iterator[tuple[tuple[str], int]]:
        """Yield the series of `topic_subscribers`."""
        for topic, number in self._ros.subscribers() if self._ros else ():
            yield (topic,), number

    def type_incompatible(self) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield the series of `type_incompatible`."""
        if self._ros is None or self.program is None:
            return
        for found, nodes in self._ros.surroundings.mistyped.items():
            for (route, topic, peer), are_commands in _uses_of_topics(self.program).items():
                if (topic, peer) == (found.topic, found.peer):
                    yield (route, topic, peer, found.type_name, str(are_commands).lower()), len(nodes)

    def other_routers(self) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield the series of `other_routers`."""
        for (host, process, _), name, is_node in self._ros.surroundings.shared if self._ros else ():
            yield (host, str(process), SHARES_NODE if is_node else SHARES_TOPIC, name), 1

    def node_namesakes(self) -> Iterator[tuple[tuple[str], int]]:
        """Yield the series of `node_namesakes`."""
        if self._ros is not None:
            yield (f"/{self._ros.name}",), self._ros.surroundings.namesakes

    def start(self, change: Change) -> None:
        """Run the prepared program, then open its gateways. Raises StartError; then the program runs without them."""
        self.adopt(change)
        with background_threads(), ExitStack() as undo:
            gateways = self._prepare_gateways(change.built, undo)
            undo.pop_all()
            self.finish(replace(change, gateways=gateways), None)

    def close_with(self, closing: ExitStack) -> None:
        """Have `closing` close sockets and ROS, after the services that use them."""
        closing.callback(self._close_listeners)
        closing.callback(self.sockets.close_senders)
        closing.callback(self._close_ros)

    def end_with(self, closing: ExitStack) -> None:
        """Have `closing` end what sends commands, each before what carries them on; deadmen of routes send last.

        The threads for messages from ROS carry the last messages of clients and of their deadmen to boards.
        """
        closing.callback(self.plane.close)
        closing.callback(self._stop_ros)
        closing.callback(self._end_client_deadmen)
        closing.callback(self._stop_gateways)
        closing.callback(self._stop_plane)

    # reloading

    def prepare(self, program: Program) -> Change:
        """Open what `program` needs that is not open yet. Raises StartError with nothing changed.

        For the first program, deadmen send here, and gateways are opened later, by `start`, because they take longer to
        open than sockets and topics.
        """
        if self._unfinished and self.plane.wait_until_adopted():
            self._close_unfinished()  # before `program` opens the same addresses or topics
        for missing in missing_extras(program.table):
            raise missing
        with ExitStack() as undo:
            _check_ports(program, os.environ)
            if self._ros is None and _needs_ros(program):
                check_environment(os.environ)  # before deadmen send, as the start may fail here
                _check_ros_arguments(program, self._ros_args)
            sockets = self.sockets.prepare(program)
            undo.callback(sockets.opened.close)
            self._counts.make_room(program.counters)
            now = self.plane.now
            state = State(self.plane.library, now.state) if now else self.plane.first_state()
            if now is None:
                self.plane.start_deadmen(program, sockets.senders, state)
            topics = self._prepare_topics(program, undo)
            opened = Opened(
                sockets.listeners,
                sockets.senders,
                topics.publications if topics else {},
                {topic: each.raw for topic, each in topics.subscriptions.items()} if topics else {},
                state,
            )
            built = self.plane.build(program, opened)
            gateways = self._prepare_gateways(built, undo) if now else None
            return Change(sockets, topics, built, gateways, undo.pop_all())

    def adopt(self, change: Change) -> None:
        """Switch all threads to the prepared program. Raises StuckError or StartError with nothing changed."""
        try:
            if self.gateways is not None and change.gateways is not None:
                self.gateways.retire(change.gateways)
            self.plane.adopt(change.built, self.sockets.unused_listeners(change.sockets))
        except BaseException:
            change.undo.close()
            raise
        change.undo.pop_all()  # discarded
        self.sockets.apply(change.sockets)
        if self._ros is not None and change.ros is not None:
            self._ros.apply(change.ros)

    def finish(self, change: Change, earlier: Built | None) -> None:
        """Watch the peers of new topics, and close what only the earlier program used.

        Sockets and topics that a stuck thread uses stay open until it continues. All steps run even if one raises.
        """
        with ExitStack() as last_first:
            last_first.callback(self._close_unused, change, earlier)
            if self._ros is not None and change.ros is not None:
                self._ros.watch(change.ros)

    def take_over(self, change: Change) -> None:
        """Adopt the prepared program, and finish. Raises StuckError or StartError with nothing changed.

        A failure after the adoption is a bug and is logged.
        """
        earlier = self.plane.now
        self.adopt(change)
        try:
            self.finish(change, earlier)
        except Exception as error:  # noqa: BLE001 a bug is logged; the program keeps running
            fault(error, "prevented it from closing unused sockets and topics").log()

    def _close_unused(self, change: Change, earlier: Built | None) -> None:
        """Close what no thread uses any more, of this reload and earlier ones."""
        self._unfinished.append(lambda: self._close_earlier(change, earlier))
        with ExitStack() as last_first:
            # The threads of a head start may still send through the sockets that moves replace.
            is_first = earlier is None and not change.sockets.moves
            if is_first or self.plane.wait_until_adopted():
                last_first.callback(self._counts.replace, change.program.counters)
                last_first.callback(self._close_unfinished)
            else:
                last_first.callback(self._counts.adopt, change.program.counters)
            if self.gateways is not None and change.gateways is not None:
                last_first.callback(self.gateways.finish, change.gateways)
                last_first.callback(self._follow_drops, self.gateways, change.gateways)

    def _close_unfinished(self) -> None:
        """Close what earlier reloads could not close, the newest first. Try each once."""
        with ExitStack() as last_first:
            for close in self._unfinished:
                last_first.callback(close)
            self._unfinished = []

    def _close_earlier(self, change: Change, earlier: Built | None) -> None:
        with ExitStack() as last_first:
            last_first.callback(change.sockets.unused.close)
            if self._ros is not None and change.ros is not None:
                last_first.callback(self._ros.finish, change.ros)
            last_first.callback(change.built.state.forget_previous)
            if earlier is not None:
                last_first.callback(self.plane.end, earlier)

    # ROS and gateways

    def _prepare_topics(self, program: Program, undo: ExitStack) -> RosChange | None:
        if self._ros is None and not _needs_ros(program):
            return None
        if self._ros is None:
            self._ros = _open_ros(program, self._ros_args, self._incompatible, self.plane.subscriber_joined)
            undo.callback(self._close_ros)
        change = self._ros.prepare(program.publishers, program.subscriptions, _topic_spans(program))
        undo.callback(self._ros.abandon, change)
        return change

    def _prepare_gateways(self, built: Built, undo: ExitStack) -> GatewayChange | None:
        if self._ros is None or not (built.program.gateways or self.gateways):
            return None
        if self.gateways is None:
            from router.gateway.thread import GatewayThread  # asyncio and websockets take 0.1 s to import

            reporter, counts = self._reporter, self._counts.gateways
            self.gateways = GatewayThread(
                self._ros, self.plane.library, counts, reporter.report, reporter.failed, self.refused
            )
            undo.callback(self._stop_gateways)
        feed = {name: deadman.feed for name, deadman in built.client_deadmen.items()}
        change = self.gateways.prepare(built.program, feed)
        undo.callback(self.gateways.abandon, change)
        return change

    def _follow_drops(self, gateways: GatewayThread, change: GatewayChange) -> None:
        drops = self.drops
        for service in change.unused:
            drops.unfollow(service.name)
        for service in change.opened:
            if service.name in gateways.kernel_drops:
                drops.follow(service.name, gateways.kernel_drops[service.name])

    def _incompatible(self, topic: str, policy: str, peers: int) -> None:
        """Count peers with an incompatible QoS policy, for each route and gateway that names the topic."""
        if (program := self.program) is None:
            return
        for name in _users_of_topics(program).get(topic, ()):
            self._counts.events[program.counters.index("qos_incompatible", name, topic, policy)] = peers

    # stopping

    def _stop_gateways(self) -> None:
        if self.gateways is not None:
            self.gateways.stop()
            self.gateways = None

    def _stop_plane(self) -> None:
        if not self.plane.stop(list(self.sockets.listeners.values())) and self._ros is not None:
            self._ros.leave_open()

    def _end_client_deadmen(self) -> None:
        if not self.plane.end_client_deadmen() and self._ros is not None:
            self._ros.leave_open()

    def _stop_ros(self) -> None:
        if not self.plane.stop_ros() and self._ros is not None:
            self._ros.leave_open()

    def _close_listeners(self) -> None:
        if self.plane.has_stopped:  # else `stop` is stuck, and a thread receives from their descriptors
            self.sockets.close_listeners()

    def _close_ros(self) -> None:
        if self._ros is not None:
            self._ros.close()
            self._ros = None


def _needs_ros(program: Program) -> bool:
    return bool(program.publishers or program.subscriptions or program.gateways)


def _check_ports(program: Program, variables: Mapping[str, str]) -> None:
    """Warn of UDP ports that ROS uses. Raises ConfigurationError for one without which ROS in this router is blind."""
    for clash in clashes(program, variables):
        if clash.blinds and _needs_ros(program) and discovers_by_multicast(variables):
            raise ConfigurationError(
                f"{clash.span}: {clash}", f"{BELOW_ROS}; or give all ROS nodes another ROS_DOMAIN_ID"
            )
        logger.warning(str(clash), remedy=BELOW_ROS)


def _check_ros_arguments(program: Program, ros_args: Sequence[str]) -> None:
    """Check the arguments. Loads ROS, which takes a while, only if there are any. Raises StartError."""
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
    kind = StartError if is_shortage(error) else ConfigurationError
    return kind(f"{program.table.path} has topics, and ROS 2 cannot be loaded: {error}", ros_remedy())


def _topic_spans(program: Program) -> Mapping[str, SourceSpan]:
    """Return the position in the table of each topic, by ROS name."""
    table = program.table
    spans = {topic.topic.value: topic.topic.span for route in table.routes for topic in route.all_topics}
    for gateway in table.gateways.values():
        for inbound in gateway.inbound:
            spans[resolved(inbound.topic.topic.value, table.node)] = inbound.topic.topic.span
    if table.node.diagnostics is not None:
        spans[DIAGNOSTICS] = table.node.diagnostics
    return spans


def _uses_of_topics(program: Program) -> Mapping[tuple[str, str, str], bool]:
    """Return the routes and gateways that use a topic, with the peers that they need there: (route, topic, peer).

    The value says whether the messages are commands.
    """
    uses: dict[tuple[str, str, str], bool] = {}
    for plan in program.routes:
        if plan.topic is not None:
            are_commands = any(target.is_command for target in plan.targets)
            uses[plan.route, plan.topic, PUBLISHER] = are_commands
        else:
            for target in plan.targets:
                if target.is_topic:
                    uses[plan.route, target.label, SUBSCRIBER] = target.is_command
    for gateway in program.gateways:
        for topic, inbound in gateway.inbound.items():
            uses[gateway.settings.name, topic, SUBSCRIBER] = inbound.is_command
    return uses


def _users_of_topics(program: Program) -> Mapping[str, Sequence[str]]:
    """Return the routes and gateways that name each topic, by ROS name."""
    names: dict[str, list[str]] = {}
    for route in program.table.routes:
        for topic in route.all_topics:
            names.setdefault(topic.topic.value, []).append(route.name)
    for gateway in program.gateways:
        for name in gateway.inbound:
            names.setdefault(name, []).append(gateway.settings.name)
    return names

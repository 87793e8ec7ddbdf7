"""The ROS node of the running program, which is opened with the first topic."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from router.app.change import Change
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import PUBLISHER, SHARES_NODE, SHARES_TOPIC, SUBSCRIBER
from router.compiler.topics import DIAGNOSTICS, resolved
from router.errors import ConfigurationError, SourceSpan, StartError
from router.ros.environment import check_environment, ros_remedy
from router.shortage import is_shortage

if TYPE_CHECKING:
    from router.ros.router_node import RouterNode


class Topics:
    """The publishers and subscriptions of the running program.

    `ros_args` are passed to rclpy. `incompatible(index, peers)` gets the counter of each route and gateway whose topic
    has peers with an incompatible QoS policy, `subscriber_joined` the topics of new subscribers.
    """

    def __init__(
        self,
        ros_args: Sequence[str],
        incompatible: Callable[[int, int], None],
        subscriber_joined: Callable[[str], None],
    ) -> None:
        self.node: RouterNode | None = None
        self._program: CompiledTable | None = None
        self._ros_args = ros_args
        self._report_incompatible = incompatible
        self._subscriber_joined = subscriber_joined

    @property
    def node_name(self) -> str:
        """The fully qualified name of the ROS node, or "" without one."""
        return self.node.name if self.node else ""

    # adoption of another program

    def check(self, program: CompiledTable) -> None:
        """Check what opening ROS may fail for, before deadmen send. Raises StartError."""
        if self.node is None and program.uses_ros:
            check_environment(os.environ)
            self._check_arguments(program)

    def prepare(self, change: Change) -> None:
        """Open the node if it is needed, and the topics that are not open yet. Raises StartError."""
        program = change.program
        if self.node is None and not program.uses_ros:
            return
        if self.node is None:
            self.node, change.opens_node = self._open_node(program), True
        change.ros = self.node.prepare(program.publishers, program.subscriptions, _topic_spans(program))

    def undo(self, change: Change) -> None:
        """Close what `prepare` has opened."""
        if self.node is not None and change.ros is not None:
            self.node.undo(change.ros)
        if change.opens_node:
            self.close()

    def adopt(self, change: Change) -> None:
        """Use the topics, and wait for events of their peers from now on."""
        self._program = change.program
        if self.node is not None and change.ros is not None:
            self.node.adopt(change.ros)

    def finish(self, change: Change) -> None:
        """Close the topics that only the earlier program used."""
        if self.node is not None and change.ros is not None:
            self.node.finish(change.ros)

    def _open_node(self, program: CompiledTable) -> RouterNode:
        """Open a node without any topic. Raises StartError."""
        try:
            from router.ros.router_node import RouterNode
        except ImportError as error:
            raise _missing_ros(program, error) from error
        return RouterNode(program.table.node, (), (), {}, self._ros_args, self._incompatible, self._subscriber_joined)

    def _check_arguments(self, program: CompiledTable) -> None:
        """Check the arguments. Loads ROS, which takes a while, only if there are any. Raises StartError."""
        if len(self._ros_args) > 1:
            try:
                from router.ros.node import check_arguments
            except ImportError as error:
                raise _missing_ros(program, error) from error
            check_arguments(self._ros_args)

    def _incompatible(self, topic: str, policy: str, peers: int) -> None:
        """Report peers with an incompatible QoS policy, for each route and gateway that names the topic."""
        if (program := self._program) is not None:
            for name in _users_of_topics(program).get(topic, ()):
                self._report_incompatible(program.counters.index("qos_incompatible", name, topic, policy), peers)

    # stopping

    def leave_open(self) -> None:
        """Have `close` leave everything open, because a thread is stuck while it takes or publishes messages."""
        if self.node is not None:
            self.node.leave_open()

    def close(self) -> None:
        if self.node is not None:
            self.node.close()
            self.node = None

    # series that are computed at each scrape

    def stalled(self) -> Iterator[tuple[str, float]]:
        """Yield the topics on which Python threads are publishing now, each with the seconds since they began."""
        yield from self.node.stalled() if self.node else ()

    def subscribers(self) -> Iterator[tuple[tuple[str], int]]:
        """Yield the series of `topic_subscribers`."""
        for topic, number in self.node.subscribers() if self.node else ():
            yield (topic,), number

    def type_incompatible(self) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield the series of `type_incompatible`."""
        if self.node is None or self._program is None:
            return
        uses = _uses_of_topics(self._program)
        for mistyped, nodes in self.node.surroundings.mistyped.items():
            for (route, topic, peer), are_commands in uses.items():
                if (topic, peer) == (mistyped.topic, mistyped.peer):
                    yield (route, topic, peer, mistyped.type_name, str(are_commands).lower()), len(nodes)

    def other_routers(self) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield the series of `other_routers`."""
        for (host, process, _), name, is_node in self.node.surroundings.shared if self.node else ():
            yield (host, str(process), SHARES_NODE if is_node else SHARES_TOPIC, name), 1

    def node_namesakes(self) -> Iterator[tuple[tuple[str], int]]:
        """Yield the series of `node_namesakes`."""
        if self.node is not None:
            yield (f"/{self.node.name}",), self.node.surroundings.namesakes


def _missing_ros(program: CompiledTable, error: ImportError) -> StartError:
    kind = StartError if is_shortage(error) else ConfigurationError
    return kind(f"{program.table.path} has topics or services, and ROS 2 cannot be loaded: {error}", ros_remedy())


def _topic_spans(program: CompiledTable) -> Mapping[str, SourceSpan]:
    """Return the position in the table of each topic, by ROS name."""
    table = program.table
    spans = {topic.topic.value: topic.topic.span for route in table.routes for topic in route.all_topics}
    for state in table.states.values():
        if state.topic is not None:
            spans[state.topic.topic.value] = state.topic.topic.span
    for gateway in table.gateways.values():
        for inbound in gateway.inbound:
            spans[resolved(inbound.topic.topic.value, table.node)] = inbound.topic.topic.span
    if table.node.diagnostics is not None:
        spans[DIAGNOSTICS] = table.node.diagnostics
    return spans


def _uses_of_topics(program: CompiledTable) -> Mapping[tuple[str, str, str], bool]:
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


def _users_of_topics(program: CompiledTable) -> Mapping[str, Sequence[str]]:
    """Return the routes and gateways that name each topic, by ROS name."""
    names: dict[str, list[str]] = {}
    for route in program.table.routes:
        for topic in route.all_topics:
            names.setdefault(topic.topic.value, []).append(route.name)
    for state in program.states:
        if state.label in state.setters:
            [topic_name] = state.setters[state.label]
            names.setdefault(topic_name, []).append(state.label)
    for gateway in program.gateways:
        for name in gateway.inbound:
            names.setdefault(name, []).append(gateway.settings.name)
    return names

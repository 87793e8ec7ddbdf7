"""What the ROS graph says about the surroundings of a router: peers of another type, other routers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from ctypes import c_int, c_void_p
from dataclasses import dataclass, field, replace
from time import sleep
from typing import NamedTuple, TypeVar

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from router.compiler.compiled_table import CompiledTable, TopicPlan
from router.compiler.metrics import PUBLISHER, SUBSCRIBER, only
from router.compiler.topics import resolved
from router.log import logger
from router.ros.marks import Router, marks, this_router
from router.ros.node import close_node, open_node
from router.ros.rcl import function

T = TypeVar("T")

_UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""The name in the graph until the node of a publisher or subscriber has been discovered."""


class Mistyped(NamedTuple):
    """A PUBLISHER or SUBSCRIBER of a topic with another type than `ours`: nothing passes between it and the router.

    `topic` is the topic's label in metrics.
    """

    topic: str
    peer: str
    type_name: str
    ours: str

    def __str__(self) -> str:
        return f"{self.topic} has a {self.peer} of {self.type_name}; {only(self.peer, self.ours)}"


class Shared(NamedTuple):
    """A topic from which another router also takes messages, or the name of the node of both if `is_node`."""

    router: Router
    name: str
    is_node: bool


@dataclass(frozen=True, slots=True)
class Ours:
    """The absolute name of a router's node, and its topics by absolute name: those it receives and publishes."""

    node: str
    received: Mapping[str, TopicPlan]
    published: Mapping[str, TopicPlan]

    @classmethod
    def of(cls, program: CompiledTable) -> Ours:
        """Return what a program opens, without remaps."""
        settings = program.table.node
        received, published = (
            {resolved(plan.topic, settings): plan for plan in plans}
            for plans in (program.subscriptions, program.publishers)
        )
        return cls(resolved(settings.name, settings), received, published)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """`mistyped` has the names of the peers' nodes. `namesakes`: other nodes of the router's name, without routers."""

    mistyped: Mapping[Mistyped, Sequence[str]] = field(default_factory=dict)
    shared: frozenset[Shared] = frozenset()
    namesakes: int = 0


def look(node: Node, ours: Ours) -> Surroundings:
    """Query the graph of `node`, which is the router's or that of a tool."""
    types = dict(node.get_topic_names_and_types())
    mistyped: dict[Mistyped, list[str]] = defaultdict(list)
    for plans, peer, ask in (
        (ours.received, PUBLISHER, rclpy_implementation.rclpy_get_publishers_info_by_topic),
        (ours.published, SUBSCRIBER, rclpy_implementation.rclpy_get_subscriptions_info_by_topic),
    ):
        for topic, plan in plans.items():
            if set(types.get(topic, ())) <= {plan.type_name}:
                continue
            with node.handle:
                endpoints = ask(node.handle, topic, False)
            for endpoint in endpoints:
                if endpoint["topic_type"] != plan.type_name:
                    name = _absolute(endpoint["node_name"], endpoint["node_namespace"])
                    mistyped[Mistyped(plan.label, peer, endpoint["topic_type"], plan.type_name)].append(name)
    marked = [(name, router) for name, router in marks(types) if router != this_router()]
    shared = frozenset(
        Shared(router, name if name == ours.node else ours.received[name].label, name == ours.node)
        for name, router in marked
        if (name == ours.node or name in ours.received) and not router.has_ended
    )
    with node.handle:
        nodes = [_absolute(*names) for names in node.handle.get_node_names_and_namespaces()]
    known = sum(name == ours.node for name, _ in marked) + (node.get_fully_qualified_name() == ours.node)
    return Surroundings(dict(mistyped), shared, max(0, nodes.count(ours.node) - known))


class Server(NamedTuple):
    """A server of a service: the absolute name of its node, and the type of the service there."""

    node: str
    type_name: str


def servers(node: Node, service: str) -> Sequence[Server]:
    """Return the servers of a service, by its absolute name, that `node` has discovered. Only for DDS.

    Each is a subscriber of the topic of requests. Queries by node would miss one of two nodes of the same name.
    """
    with node.handle:
        found = rclpy_implementation.rclpy_get_subscriptions_info_by_topic(node.handle, f"rq{service}Request", True)
    return [
        Server(_absolute(each["node_name"], each["node_namespace"]), _service_type(each["topic_type"]))
        for each in found
    ]


def _service_type(name: str) -> str:
    """Return `std_srvs/srv/SetBool` for the type of its requests in DDS, `std_srvs::srv::dds_::SetBool_Request_`."""
    return name.replace("::dds_::", "::").removesuffix("_Request_").replace("::", "/")


def look_once(tool: str, seconds: float, look_at: Callable[[Node], T]) -> T:
    """Query the graph of a node with this name, `seconds` after opening it. Raises StartError."""
    node = open_node(tool)
    try:
        sleep(seconds)
        return look_at(node)
    finally:
        close_node(node)


class GraphChanges:
    """Tells whether the graph has changed. For one thread."""

    def __init__(self, node: Node) -> None:
        self._set = rclpy_implementation.WaitSet(0, 1, 0, 0, 0, 0, node.context.handle)
        with node.handle:
            self._changed = _graph_guard_condition(node.handle.pointer)

    def seen(self) -> bool:
        """Return whether the graph has changed since the last call."""
        self._set.clear_entities()
        if _add_guard_condition(self._set.pointer, self._changed, None):
            return True
        self._set.wait(0)
        return bool(self._set.is_ready("guard_condition", 0))

    def close(self) -> None:
        self._set.destroy_when_not_in_use()


_graph_guard_condition = function("rcl_node_get_graph_guard_condition", c_void_p, c_void_p)
_add_guard_condition = function("rcl_wait_set_add_guard_condition", c_int, c_void_p, c_void_p, c_void_p)


class GraphWatch:
    """Looks at the graph, and logs what is new there. For one thread; others may read `now`."""

    def __init__(self, node: Node) -> None:
        self.now = Surroundings()
        self._node = node
        self._changes = GraphChanges(node)
        self._ours: Ours | None = None
        self._namesakes = 0

    def close(self) -> None:
        self._changes.close()

    def check(self, ours: Ours) -> None:
        """Look at the graph if it, or `ours`, has changed, or if anything was found there."""
        has_changed = self._changes.seen() or ours is not self._ours
        if not has_changed and not self._namesakes and self.now == Surroundings():
            return
        self._ours = ours
        latest = look(self._node, ours)
        # A node and its topics are discovered one after the other.
        namesakes, self._namesakes = min(latest.namesakes, self._namesakes), latest.namesakes
        before, self.now = self.now, replace(latest, namesakes=namesakes)
        for mistyped in self.now.mistyped.keys() - before.mistyped.keys():
            nodes = {name for name in self.now.mistyped[mistyped] if not name.endswith(_UNKNOWN)}
            logger.warning(str(mistyped), topic=mistyped.topic, nodes=sorted(nodes))
        _log_routers(self.now.shared - before.shared)
        if self.now.namesakes > before.namesakes:
            logger.warning("another node has the name of this router", node=ours.node)


def _log_routers(new: Iterable[Shared]) -> None:
    by_router: dict[Router, list[str]] = defaultdict(list)
    for shared in sorted(new):
        by_router[shared.router].append(shared.name)
    for router, names in by_router.items():
        what = "another router has the name of this one or takes messages from the same topics"
        logger.warning(what, host=router.host, process=router.process, shared=names)


def _absolute(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"

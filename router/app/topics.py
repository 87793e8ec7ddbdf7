"""Opens the ROS side of a program, which a table without topics does not need."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from router.compiler.program import Program
from router.compiler.topics import DIAGNOSTICS, resolved
from router.errors import SourceSpan, StartError
from router.ros.environment import ros_remedy

if TYPE_CHECKING:
    from router.ros.node_and_publishers import RosEdge


def wants_ros(program: Program) -> bool:
    return bool(program.publishers or program.subscriptions or program.gateways)


def open_ros(
    program: Program,
    ros_args: Sequence[str],
    incompatible: Callable[[str, str, int], None],
    met: Callable[[str], None],
) -> RosEdge:
    """A node without any topic. Raises StartError."""
    try:
        from router.ros.node_and_publishers import RosEdge
    except ImportError as error:
        what = f"{program.table.path} has topics, and ROS 2 cannot be loaded: {error}"
        raise StartError(f"{what}; {ros_remedy()}") from error
    return RosEdge(program.table.node, (), (), {}, ros_args, incompatible, met)


def places(program: Program) -> Mapping[str, SourceSpan]:
    """Where the table names each topic."""
    table = program.table
    spans = {topic.topic.value: topic.topic.span for route in table.routes for topic in route.topics}
    for gateway in table.gateways.values():
        for inbound in gateway.inbound:
            spans[resolved(inbound.topic.topic.value, table.node)] = inbound.topic.topic.span
    if table.node.diagnostics is not None:
        spans[DIAGNOSTICS] = table.node.diagnostics
    return spans


def who_names(program: Program) -> Mapping[str, Sequence[str]]:
    """The routes and gateways that name each topic."""
    names: dict[str, list[str]] = {}
    for route in program.table.routes:
        for topic in route.topics:
            names.setdefault(topic.topic.value, []).append(route.name)
    for gateway in program.gateways:
        for name in gateway.inbound:
            names.setdefault(name, []).append(gateway.settings.name)
    return names

"""ROS 2: one node with the program's publishers. The only module that imports rclpy.

Knows bytes and topics; what the bytes mean and why they are published is the engine's business.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.context import Context
from rclpy.duration import Duration, Infinite
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)

from router.compiler.program import QosPlan, TopicPlan
from router.edges.log import logger
from router.errors import SourceSpan, StartError
from router.table.model import NodeSettings

PUBLISH_ERRORS = (rclpy_implementation.RCLError,)
"""What `publish[topic]` may raise."""

_RCL_ERRORS = (RuntimeError, NameValidationException)
"""What rclpy raises for bad arguments, names and settings: its own errors derive from RuntimeError."""


class RosEdge:
    """The node, its publishers, and the thread that serves their events. Opening raises StartError.

    `publish[topic]` takes CDR bytes. `wanted[topic]` is one boolean in a list, kept up to date in place:
    whether anybody listens. Signals are left alone. The context is our own, not rclpy's global one.
    """

    def __init__(
        self,
        node: NodeSettings,
        publishers: Sequence[TopicPlan],
        spans: Mapping[str, SourceSpan],
        ros_args: Sequence[str] = (),
    ) -> None:
        self.publish: dict[str, Callable[[bytes], None]] = {}
        self.wanted: dict[str, list[bool]] = {}
        self._entered: list[Any] = []
        classes = {plan.topic: _message_class(plan, spans[plan.topic]) for plan in publishers}
        self._context = Context()
        try:
            # The router has a log of its own: no log file of ROS, no /rosout. Nor parameter services:
            # parameters fill the table's variables at start, so a service that sets them would pretend.
            self._context.init(list(ros_args), initialize_logging=False)
            self._node = Node(
                node.name,
                namespace=node.namespace,
                context=self._context,
                enable_rosout=False,
                start_parameter_services=False,
            )
        except _RCL_ERRORS as error:
            self._context.try_shutdown()
            raise StartError(f"the ROS node cannot be created: {error}") from error
        for plan in publishers:
            try:
                self._open(plan, classes[plan.topic])
            except _RCL_ERRORS as error:
                self._destroy()
                raise StartError(f"{spans[plan.topic]}: topic '{plan.topic}' cannot be published: {error}") from error
        self._stopping = False
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="ros")
        self._thread.start()

    def _open(self, plan: TopicPlan, message_class: type) -> None:
        wanted = [plan.qos.serves_late_joiners]
        publisher = self._node.create_publisher(
            message_class, plan.topic, _qos_profile(plan.qos), event_callbacks=_events(plan, wanted)
        )
        # Publisher.publish() enters the handle and looks at the message's type each time, which doubles its cost.
        handle = publisher.handle
        handle.__enter__()
        self._entered.append(handle)
        self.publish[plan.topic] = handle.publish_raw
        self.wanted[plan.topic] = wanted

    def _spin(self) -> None:
        while not self._stopping:
            self._executor.spin_once()
        self._executor.shutdown()

    def close(self) -> None:
        """Nothing may be published any more when this is called."""
        self._stopping = True
        self._executor.create_task(lambda: None)  # wakes the thread, which then sees that it is to stop
        self._thread.join()
        self._destroy()

    def _destroy(self) -> None:
        for handle in self._entered:
            handle.__exit__(None, None, None)
        self._node.destroy_node()
        self._context.try_shutdown()


def _events(plan: TopicPlan, wanted: list[bool]) -> PublisherEventCallbacks:
    def on_matched(status: Any) -> None:
        wanted[0] = plan.qos.serves_late_joiners or status.current_count > 0

    def on_incompatible_qos(status: Any) -> None:
        logger.warning(
            "a subscriber asks for a QoS that the table does not offer, and gets nothing",
            topic=plan.topic,
            policy=qos_policy_name_from_kind(status.last_policy_kind),
        )

    def on_incompatible_type(_: Any) -> None:
        logger.warning("a subscriber expects another type, and gets nothing", topic=plan.topic, type=plan.type_name)

    return PublisherEventCallbacks(
        matched=on_matched, incompatible_qos=on_incompatible_qos, incompatible_type=on_incompatible_type
    )


def _message_class(plan: TopicPlan, span: SourceSpan) -> type:
    """The installed Python class; it and all in it must be laid out as the table was compiled for."""
    for name, compiled in plan.definitions.items():
        installed = tuple(_installed(name, span).get_fields_and_field_types().items())
        if installed != compiled:
            raise StartError(
                f"{span}: {name} as installed is not what the table was compiled for; {_remedy(name)}\n"
                f"  installed: {_fields(installed)}\n  compiled:  {_fields(compiled)}"
            )
    return _installed(plan.type_name, span)  # type: ignore[no-any-return]


def _installed(name: str, span: SourceSpan) -> Any:
    package, _, short = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError) as error:
        raise StartError(f"{span}: {name} is not installed ({error}); {_remedy(name)}") from error


def _remedy(name: str) -> str:
    return f"run 'make setup', or install the ROS package '{name.partition('/')[0]}'"


def _fields(definition: tuple[tuple[str, str], ...]) -> str:
    return ", ".join(f"{kind} {name}" for name, kind in definition)


def _qos_profile(plan: QosPlan) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy[plan.reliability.upper()],
        durability=DurabilityPolicy[plan.durability.upper()],
        history=HistoryPolicy[plan.history.upper()],
        depth=plan.depth,
        deadline=_duration(plan.deadline),
        lifespan=_duration(plan.lifespan),
        liveliness=LivelinessPolicy[plan.liveliness.upper()],
        liveliness_lease_duration=_duration(plan.liveliness_lease_duration),
    )


def _duration(nanoseconds: int | None) -> Duration:
    return Infinite if nanoseconds is None else Duration(nanoseconds=nanoseconds)

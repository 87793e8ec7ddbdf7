"""The topics that a node has discovered, and taps on them, for whoever follows topics that no table names.

Which topics those are, and what their bytes mean, is not known here.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, NamedTuple

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_support import check_is_valid_msg_type

from router.errors import StartError
from router.ros.arrivals import RawSubscription
from router.ros.definitions import installed_type
from router.ros.node import RCL_ERRORS
from router.ros.types import Definition, matching_class
from router.types.model import MessageType


class SeenPublisher(NamedTuple):
    """A publisher that was discovered. `keeps` says that it keeps messages for those who join late.

    `is_ours` says that it belongs to the node that looks.
    """

    type_name: str
    is_reliable: bool
    keeps: bool
    is_ours: bool


class RosTopics:
    """What `node` knows of all topics. Names are absolute ones."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._handle = node.handle
        self._name = node.get_name(), node.get_namespace()

    def names(self) -> list[str]:
        """Topics that somebody publishes or subscribes to."""
        return [name for name, _ in self._node.get_topic_names_and_types()]

    def publishers(self, topic: str) -> list[SeenPublisher]:
        """Those of `topic`, whatever their types."""
        return [
            SeenPublisher(
                type_name=seen["topic_type"],
                is_reliable=seen["qos_profile"]["reliability"] == ReliabilityPolicy.RELIABLE,
                keeps=seen["qos_profile"]["durability"] == DurabilityPolicy.TRANSIENT_LOCAL,
                is_ours=self._is_ours(seen),
            )
            for seen in self._ask(rclpy_implementation.rclpy_get_publishers_info_by_topic, topic)
        ]

    def resolved(self, name: str) -> str:
        """The absolute name that ROS makes of one: by the node's namespace, and then by its remaps."""
        return str(self._node.resolve_topic_name(name))

    def _ask(self, question: Callable[[Any, str, bool], list[dict[str, Any]]], topic: str) -> list[dict[str, Any]]:
        """As rclpy's Node does, which makes an object of each QoS and takes three times as long."""
        with self._handle:
            return question(self._handle, topic, False)

    def _is_ours(self, seen: Mapping[str, Any]) -> bool:
        return (seen["node_name"], seen["node_namespace"]) == self._name

    def installed_type(self, type_name: str) -> MessageType:
        """As its class describes it. Raises StartError. Takes as long as `load`; any thread may call this."""
        return installed_type(type_name)

    def load(self, type_name: str, definitions: Mapping[str, Definition]) -> Any:
        """The class of a message, for `tap`, if it is installed as `definitions` say. Raises StartError.

        The first of a package reads files for some 10 ms; any thread may call this.
        """
        message_class = matching_class(type_name, definitions)
        try:
            check_is_valid_msg_type(message_class)
        except Exception as error:
            raise StartError(f"{type_name} cannot be received: {error}") from error
        return message_class

    def tap(self, topic: str, message_class: Any, *, is_reliable: bool, keeps: bool, depth: int) -> TopicTap:
        """Subscribes to `topic`. Raises StartError, also where our node has the topic with another type.

        And where a remap of our node leads from it to another one, whose messages would pass for its.
        """
        type_name = "/".join((*message_class.__module__.split(".")[:2], message_class.__name__))
        try:
            others = self._our_types(topic) - {type_name}
            if (renamed := self.resolved(topic)) != topic:
                raise StartError(f"a remap of this router makes '{renamed}' of '{topic}'; remap relative names instead")
            if others:  # DDS has one for a topic in a process; it would say so in other words
                raise StartError(f"topic '{topic}' is {others.pop()} in this router, and cannot be {type_name} too")
            return TopicTap(
                self._node, topic, message_class, hearing(is_reliable=is_reliable, keeps=keeps, depth=depth)
            )
        except (*RCL_ERRORS, OSError) as error:
            raise StartError(f"topic '{topic}' cannot be subscribed to: {error}") from error

    def _our_types(self, topic: str) -> set[str]:
        """With which our node publishes or subscribes to it."""
        seen = [
            *self._ask(rclpy_implementation.rclpy_get_publishers_info_by_topic, topic),
            *self._ask(rclpy_implementation.rclpy_get_subscriptions_info_by_topic, topic),
        ]
        return {endpoint["topic_type"] for endpoint in seen if self._is_ours(endpoint)}


class TopicTap:
    """A subscription that is asked instead of telling: what nobody takes costs no Python at all. Close it.

    `fd` is readable while messages have come that `arrived` has not counted.
    """

    def __init__(self, node: Node, topic: str, message_class: Any, qos: QoSProfile) -> None:
        """Raises one of `ros_node.RCL_ERRORS`, or OSError where no more files may be open."""
        silent = SubscriptionEventCallbacks(use_default_callbacks=False)
        with ExitStack() as opening:
            self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            opening.callback(os.close, self.fd)
            subscription = RawSubscription(node, message_class, topic, qos, silent)
            opening.callback(subscription.close)
            subscription.announce_to(self.fd)  # what has come already is announced at once
            opening.callback(subscription.announce_to, None)
            self._open = opening.pop_all()
        self.take = subscription.take

    def arrived(self) -> int:
        """How many messages have come since this was asked last, taken or not. Does not wait."""
        try:
            return os.eventfd_read(self.fd)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Nobody may `take` any more."""
        self._open.close()


def hearing(*, is_reliable: bool, keeps: bool, depth: int) -> QoSProfile:
    """The newest `depth` messages. Best effort hears every publisher; only reliable ones give what they have kept."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if keeps else DurabilityPolicy.VOLATILE,
    )

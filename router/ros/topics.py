"""Topics outside of the table: discovery, taps for gateways, and a listener for `router listen`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import islice
from time import monotonic, sleep
from types import MappingProxyType
from typing import Any, NamedTuple

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from router.declared import Wanted
from router.errors import StartError, TransportError
from router.ros.endpoints import Publication
from router.ros.node import RCL_ERRORS, close_node, open_node
from router.ros.receiving import Arrivals, RawSubscription
from router.ros.type_support import Definition
from router.ros.types import installed_type, loaded_class, usable_class
from router.types.model import MessageType

DEPTH = 100
"""Messages that are kept between two calls of `take`; older ones are lost."""

_DISCOVERY_INTERVAL = 0.05


class DiscoveredPublisher(NamedTuple):
    """A publisher. `keeps`: it keeps messages for late joiners. `is_ours`: it belongs to the discovering node.

    `gid` is unique.
    """

    type_name: str
    is_reliable: bool
    keeps: bool
    is_ours: bool
    gid: bytes


class RosTopics:
    """The topics that `node` has discovered. Names are absolute. `types` are those of the table's topics.

    `published` are the publishers of this process.
    """

    def __init__(
        self, node: Node, types: Mapping[str, str], published: Mapping[str, Publication] = MappingProxyType({})
    ) -> None:
        self.types = types
        self._published = published
        self._node = node
        self._handle = node.handle
        self._name = node.get_name(), node.get_namespace()

    def names(self) -> list[str]:
        """Return the topics with publishers or subscribers."""
        return [name for name, _ in self._node.get_topic_names_and_types()]

    def publishers(self, topic: str) -> list[DiscoveredPublisher]:
        """Return the publishers of `topic`, of any type."""
        return [
            DiscoveredPublisher(
                type_name=seen["topic_type"],
                is_reliable=seen["qos_profile"]["reliability"] == ReliabilityPolicy.RELIABLE,
                keeps=seen["qos_profile"]["durability"] == DurabilityPolicy.TRANSIENT_LOCAL,
                is_ours=self._is_ours(seen),
                gid=bytes(seen["endpoint_gid"]),
            )
            for seen in self._query(rclpy_implementation.rclpy_get_publishers_info_by_topic, topic)
        ]

    def has_publishers(self, topic: str) -> bool:
        """Return whether `topic` has publishers, without the cost of looking at them."""
        with self._handle:
            return bool(self._handle.get_count_publishers(topic))

    def resolved(self, name: str) -> str:
        """Return the absolute name of a topic, from the node's namespace and remaps."""
        return str(self._node.resolve_topic_name(name))

    def _query(self, function: Callable[[Any, str, bool], list[dict[str, Any]]], topic: str) -> list[dict[str, Any]]:
        """Query the graph, three times as fast as rclpy's Node, which makes an object of each QoS."""
        with self._handle:
            return function(self._handle, topic, False)

    def _is_ours(self, seen: Mapping[str, Any]) -> bool:
        return (seen["node_name"], seen["node_namespace"]) == self._name

    def installed_type(self, type_name: str) -> MessageType:
        """Like `types.installed_type`. Takes as long as `load`; thread-safe."""
        return installed_type(type_name)

    def load(self, type_name: str, definitions: Mapping[str, Definition]) -> Any:
        """Like `types.usable_class`, for `tap`. Thread-safe."""
        return usable_class(type_name, definitions)

    def tap(self, topic: str, message_class: Any, *, is_reliable: bool, keeps: bool, depth: int) -> TopicTap:
        """Subscribe to `topic`.

        Raises StartError, also if our node has the topic with another type, or if a remap of our node renames the
        topic, because messages of another topic would appear under its name.
        """
        type_name = "/".join((*message_class.__module__.split(".")[:2], message_class.__name__))
        try:
            others = self._our_types(topic) - {type_name}
            if (renamed := self.resolved(topic)) != topic:
                raise StartError(
                    f"a remap of this router changes '{topic}' to '{renamed}'", "remap relative names instead"
                )
            if others:  # DDS allows one type per topic in a process
                raise StartError(f"topic '{topic}' is {others.pop()} in this router, so it cannot be {type_name}")
            qos = tap_qos(is_reliable=is_reliable, keeps=keeps, depth=depth)
            return TopicTap(self._node, topic, message_class, qos, self._published.get(topic) if depth == 1 else None)
        except (*RCL_ERRORS, OSError) as error:
            raise StartError(f"topic '{topic}' cannot be subscribed to: {error}") from error

    def _our_types(self, topic: str) -> set[str]:
        """Return the types with which our node publishes or subscribes to the topic."""
        seen = [
            *self._query(rclpy_implementation.rclpy_get_publishers_info_by_topic, topic),
            *self._query(rclpy_implementation.rclpy_get_subscriptions_info_by_topic, topic),
        ]
        return {endpoint["topic_type"] for endpoint in seen if self._is_ours(endpoint)}


class TopicTap:
    """A polled subscription: messages that are not taken cost no time in Python. The caller must close it.

    `fd` is readable while there are messages that `arrived` has not counted. `sampled` is a publisher of this process:
    if it has no other subscribers, it publishes only after `ask`.
    """

    def __init__(
        self, node: Node, topic: str, message_class: Any, qos: QoSProfile, sampled: Publication | None = None
    ) -> None:
        """Subscribe to a topic. Raises one of `RCL_ERRORS`, or OSError if too many files are open."""
        silent = SubscriptionEventCallbacks(use_default_callbacks=False)
        with ExitStack() as opening:
            self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            opening.callback(os.close, self.fd)
            subscription = RawSubscription(node, message_class, topic, qos, silent)
            opening.callback(subscription.close)
            subscription.announce_to(self.fd)  # reports earlier messages at once
            opening.callback(subscription.announce_to, None)
            if sampled is not None:
                self._replaced = sampled.demand.replaced
                sampled.note_samplers(1)
                opening.callback(sampled.note_samplers, -1)
            self._open = opening.pop_all()
        self._sampled = sampled
        self.take = subscription.take

    def ask(self) -> bool:
        """Ask for the newest message, unless each one arrives anyway. Then wake the thread that publishes."""
        if self._sampled is None or self._sampled.demand.wanted != Wanted.NEWEST_MESSAGE:
            return False
        self._sampled.demand.is_due = 1
        return True

    def arrived(self) -> int:
        """Return the number of messages that have arrived since the last call, taken or not. Does not wait.

        Those count that the publisher replaced by newer ones before it was asked.
        """
        arrived = 0
        if self._sampled is not None:
            before, self._replaced = self._replaced, self._sampled.demand.replaced
            arrived = self._replaced - before
        with suppress(BlockingIOError):
            arrived += os.eventfd_read(self.fd)
        return arrived

    def close(self) -> None:
        self._open.close()


def tap_qos(*, is_reliable: bool, keeps: bool, depth: int) -> QoSProfile:
    """Return a QoS for the newest `depth` messages. Best effort matches all publishers; kept messages need reliable."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if keeps else DurabilityPolicy.VOLATILE,
    )


class TopicListener:
    """A subscription to `topic` with a node of its own. Raises StartError. The caller must close it.

    Without a `type_name`, opening waits `patience` seconds for the first publisher, and raises TransportError if there
    is none. If all publishers keep messages for late joiners, `take` also returns these.
    """

    def __init__(
        self, topic: str, type_name: str | None = None, ros_args: Sequence[str] = (), patience: float = math.inf
    ) -> None:
        if type_name is not None and type_name.count("/") != 2:
            raise StartError(f"'{type_name}' is not a message type", "write it like std_msgs/msg/String")
        with ExitStack() as opening:
            node = open_node("router_tap", ros_args=ros_args)
            opening.callback(close_node, node)
            try:
                publishers = _publishers(node, topic, patience if type_name is None else 0.0)
                if type_name is None and not publishers:
                    raise TransportError(f"topic '{topic}' has no publisher")
                self.type_name = type_name or publishers[0].type_name
                self._message_class = loaded_class(self.type_name)
                self._subscription = RawSubscription(node, self._message_class, topic, _qos(publishers))
                self._arrivals = Arrivals([self._subscription])
            except (*RCL_ERRORS, ValueError) as error:
                raise StartError(f"topic '{topic}' cannot be listened to: {error}") from error
            opening.callback(self._arrivals.close)
            self._open = opening.pop_all()

    def take(self, timeout: float) -> list[tuple[bytes, int]]:
        """Wait up to `timeout` seconds; return each message's CDR bytes and time of sending, in ns of the wall clock.

        Ctrl-C is handled when the wait is over.
        """
        self._arrivals.wait(timeout)
        return list(islice(iter(self._subscription.take, None), DEPTH))

    def message(self, cdr: bytes) -> Any:
        """Deserialize a message."""
        return deserialize_message(cdr, self._message_class)

    def close(self) -> None:
        self._open.close()


def _publishers(node: Node, topic: str, patience: float) -> Sequence[DiscoveredPublisher]:
    """Return the publishers discovered so far; waits up to `patience` seconds for the first one."""
    topics, name, until = RosTopics(node, {}), node.resolve_topic_name(topic), monotonic() + patience
    while not (publishers := topics.publishers(name)) and monotonic() < until:
        sleep(_DISCOVERY_INTERVAL)
    return publishers


def _qos(publishers: Sequence[DiscoveredPublisher]) -> QoSProfile:
    """Return a QoS: best effort matches every publisher and delays none; kept messages need a reliable subscription."""
    keeps = bool(publishers) and all(publisher.is_reliable and publisher.keeps for publisher in publishers)
    return tap_qos(is_reliable=keeps, keeps=keeps, depth=DEPTH)

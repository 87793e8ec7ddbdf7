"""Listens to one ROS topic for somebody who wants to see what it carries. Knows no table and no router."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from itertools import islice
from time import sleep
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from router.errors import StartError
from router.ros.arrivals import Arrivals, RawSubscription
from router.ros.node import RCL_ERRORS, close_node, open_node
from router.ros.topics import RosTopics, SeenPublisher, hearing
from router.ros.types import installed_class

DEPTH = 100
"""Messages that are kept between two calls of `take`; the oldest go first."""

_LOOK_INTERVAL = 0.05


class TopicListener:
    """Subscribed to `topic` on a node of its own. Raises StartError; close it.

    Without a `type_name` opening waits for the first publisher. When all publishers that are there keep messages
    for late joiners, `take` gives those as well.
    """

    def __init__(self, topic: str, type_name: str | None = None, ros_args: Sequence[str] = ()) -> None:
        if type_name is not None and type_name.count("/") != 2:
            raise StartError(f"'{type_name}' is no message type; they are written like std_msgs/msg/String")
        with ExitStack() as opening:
            node = open_node("router_tap", ros_args=ros_args)
            opening.callback(close_node, node)
            try:
                publishers = _publishers(node, topic, wait=type_name is None)
                self.type_name = type_name or publishers[0].type_name
                self._message_class = installed_class(self.type_name)
                self._subscription = RawSubscription(node, self._message_class, topic, _qos(publishers))
                self._arrivals = Arrivals([self._subscription])
            except (*RCL_ERRORS, ValueError) as error:
                raise StartError(f"topic '{topic}' cannot be listened to: {error}") from error
            opening.callback(self._arrivals.close)
            self._open = opening.pop_all()

    def take(self, timeout: float) -> list[tuple[bytes, int]]:
        """Waits up to `timeout` seconds for messages: the CDR bytes of each, and the wall clock ns at which it set out.

        Ctrl-C is only noticed when the wait is over.
        """
        self._arrivals.wait(timeout)
        return list(islice(iter(self._subscription.take, None), DEPTH))

    def message(self, cdr: bytes) -> Any:
        """The ROS message object that the bytes are."""
        return deserialize_message(cdr, self._message_class)

    def close(self) -> None:
        self._open.close()


def _publishers(node: Node, topic: str, *, wait: bool) -> Sequence[SeenPublisher]:
    """Those that have been discovered."""
    topics, name = RosTopics(node), node.resolve_topic_name(topic)
    while not (publishers := topics.publishers(name)) and wait:
        sleep(_LOOK_INTERVAL)
    return publishers


def _qos(publishers: Sequence[SeenPublisher]) -> QoSProfile:
    """Best effort hears every publisher and makes none of them wait; kept messages come to reliable ones alone."""
    keeps = bool(publishers) and all(publisher.is_reliable and publisher.keeps for publisher in publishers)
    return hearing(is_reliable=keeps, keeps=keeps, depth=DEPTH)

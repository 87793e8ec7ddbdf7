"""A ROS 2 node that shares only the table's topic names with the router, and counts the messages that arrive.

`python -m demo.ros_listener TABLE` prints a JSON object twice a second:
{"topics": {topic: {"publishers": number discovered, "count": messages so far,
                    "sample": the newest one, decoded by rclpy, as text}}}
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from demo.expected import checked_table, inbound_topics
from demo.ros_messages import message_class

REPORT_INTERVAL = 0.5
"""Seconds."""

ANY_PUBLISHER = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches publishers of every QoS."""


class Listener:
    """Counts raw messages; decodes only the samples that it reports."""

    def __init__(self, node: Node, topics: dict[str, str]) -> None:
        self._node = node
        self._counts = dict.fromkeys(topics, 0)
        self._newest: dict[str, bytes] = {}
        self._types = {topic: message_class(name) for topic, name in topics.items()}
        for topic, kind in self._types.items():
            node.create_subscription(kind, topic, partial(self._take, topic), ANY_PUBLISHER, raw=True)

    def _take(self, topic: str, data: bytes) -> None:
        self._counts[topic] += 1
        self._newest[topic] = data

    def report(self) -> None:
        topics = {
            topic: {"publishers": self._node.count_publishers(topic), "count": count, "sample": self._sample(topic)}
            for topic, count in self._counts.items()
        }
        print(json.dumps({"topics": topics}), flush=True)

    def _sample(self, topic: str) -> str:
        data = self._newest.get(topic)
        return "" if data is None else str(deserialize_message(data, self._types[topic]))


def main() -> int:
    table = checked_table(Path(sys.argv[1]))
    rclpy.init()
    node = rclpy.create_node("demo_listener", namespace=table.node.namespace)
    listener = Listener(node, inbound_topics(table))
    node.create_timer(REPORT_INTERVAL, listener.report)
    listener.report()
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        listener.report()
    return 0


if __name__ == "__main__":
    sys.exit(main())

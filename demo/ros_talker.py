"""The rover's software, as far as the router can tell: publishes every topic that the table takes from ROS.

It commands the boards for some seconds, then leaves them to the operator.

`python -m demo.ros_talker TABLE`
"""

from __future__ import annotations

import itertools
import signal
import sys
import threading
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from demo.expected import checked_table, command_topics, outbound_topics
from demo.ros_messages import filled, message_class

INTERVAL = 0.1
"""Seconds."""

COMMANDING = 3.0
"""Seconds after the start, in which it commands the boards: less than until the operator is cut off."""

ANY_SUBSCRIBER = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Reliable and kept: what a subscriber may ask for at most."""


def talk(node: Node, topics: dict[str, str], commands: set[str], ended: threading.Event) -> None:
    """One message on each topic in every INTERVAL, on those of `commands` while COMMANDING."""
    classes = {topic: message_class(name) for topic, name in topics.items()}
    publishers = {topic: node.create_publisher(kind, topic, ANY_SUBSCRIBER) for topic, kind in classes.items()}
    for number in itertools.count():
        stamp = node.get_clock().now().to_msg()
        for topic, publisher in publishers.items():
            if topic not in commands or number * INTERVAL < COMMANDING:
                publisher.publish(filled(classes[topic], number, stamp))
        if ended.wait(INTERVAL):
            return


def main() -> int:
    table = checked_table(Path(sys.argv[1]))
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # which would end ROS between two publishers
    node = rclpy.create_node("demo_talker", namespace=table.node.namespace)
    talk(node, outbound_topics(table), command_topics(table), ended)
    rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())

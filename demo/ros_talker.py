"""Stands for the rover's software: publishes every topic that the table takes from ROS.

`python -m demo.ros_talker TABLE` prints {"ready": true} when the router has subscribed to all of them. Then it reads a
time of CLOCK_MONOTONIC in seconds from stdin, and begins to publish. From that time on it sends no more commands to
boards, so that the operator drives.
"""

from __future__ import annotations

import itertools
import json
import signal
import sys
import threading
import time
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from demo.expected import checked_table, command_topics, outbound_topics
from demo.ros_messages import filled, message_class

INTERVAL = 0.1
"""Seconds."""

ANY_SUBSCRIBER = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Reliable and transient local: compatible with every subscriber."""


def talk(
    node: Node, publishers: dict[str, Publisher], commands: set[str], until: float, ended: threading.Event
) -> None:
    """Publish one message per INTERVAL on each topic; on topics of `commands` only before the time `until`."""
    for number in itertools.count():
        stamp = node.get_clock().now().to_msg()
        for topic, publisher in publishers.items():
            if topic not in commands or time.monotonic() < until:
                publisher.publish(filled(publisher.msg_type, number, stamp))
        if ended.wait(INTERVAL):
            return


def main() -> int:
    table = checked_table(Path(sys.argv[1]))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its handler would interrupt talk()
    node = rclpy.create_node("demo_talker", namespace=table.node.namespace)
    publishers = {
        topic: node.create_publisher(message_class(name), topic, ANY_SUBSCRIBER)
        for topic, name in outbound_topics(table).items()
    }
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        time.sleep(INTERVAL)
    print(json.dumps({"ready": True}), flush=True)
    until = float(sys.stdin.readline())
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())  # before, SIGTERM ended the process
    talk(node, publishers, command_topics(table), until, ended)
    rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())

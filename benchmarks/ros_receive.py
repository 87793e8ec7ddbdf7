"""What receiving a ROS message costs: this router's thread beside rclpy's SingleThreadedExecutor.

    python -m benchmarks.ros_receive --rate 500

Another process publishes to six topics in turn; the node has 24 publishers besides. Prints the processor time of the
receiving thread per message, raw bytes in both cases. All on the loopback interface.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing

# Before anything imports rclpy.
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from router.ros.node import close_node, open_node
from tests.ros.opening import HELLO, open_ros, string_topic

SUBSCRIBED = tuple(f"command_{number}" for number in range(6))
PUBLISHED = tuple(f"telemetry_{number}" for number in range(24))
SECONDS = 4


class Meter:
    """Counts messages, and the processor time of the thread that hands them over, until there were `most`."""

    def __init__(self, most: int) -> None:
        self.full = threading.Event()
        self._most = most
        self._count = 0
        self._began = 0
        self.us_each = 0.0

    def count(self, _: bytes, __: int = 0) -> None:
        if not self._count:
            self._began = time.thread_time_ns()
        self._count += 1
        if self._count == self._most:
            self.us_each = (time.thread_time_ns() - self._began) / 1000 / self._most
            self.full.set()


def with_router(meter: Meter) -> None:
    published, subscribed = ([string_topic(topic=topic) for topic in topics] for topics in (PUBLISHED, SUBSCRIBED))
    with closing(open_ros(*published, subscriptions=subscribed)) as ros:
        ros.start(dict.fromkeys(SUBSCRIBED, meter.count), print)
        meter.full.wait()


def with_executor(meter: Meter) -> None:
    node = open_node("receiver")
    for topic in PUBLISHED:
        node.create_publisher(String, topic, QoSProfile(depth=10))
    for topic in SUBSCRIBED:
        node.create_subscription(String, topic, meter.count, QoSProfile(depth=10), raw=True)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while not meter.full.is_set():
        executor.spin_once()
    executor.shutdown()
    close_node(node)


def publish(rate: float) -> None:
    """To each topic in turn, until this process is ended."""
    rclpy.init(args=[])
    node = rclpy.create_node("sender")
    publishers = [node.create_publisher(String, topic, QoSProfile(depth=10)) for topic in SUBSCRIBED]
    due = time.perf_counter()
    while True:
        for publisher in publishers:
            publisher.publish(HELLO)
            due += 1 / rate
            time.sleep(max(0.0, due - time.perf_counter()))


def measured(receive: Callable[[Meter], None], rate: float) -> float:
    meter = Meter(int(rate * SECONDS))
    with subprocess.Popen([sys.executable, "-m", __spec__.name, "--publish", "--rate", str(rate)]) as sender:
        try:
            receive(meter)
        finally:
            sender.kill()
    return meter.us_each


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=500, help="messages per second, all topics together")
    parser.add_argument("--publish", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.publish:
        publish(arguments.rate)
    for name, receive in (("router", with_router), ("SingleThreadedExecutor", with_executor)):
        print(f"{name:<24}{measured(receive, arguments.rate):6.1f} us per message")


if __name__ == "__main__":
    main()

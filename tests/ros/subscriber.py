"""A ROS subscriber in a process of its own: `Subscriber` starts it, and this file run as a script is it.

It prints "matched" once a publisher is there, then each message's bytes in hex, and ends with its standard input.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # a script is not started from the repository's root

from router.ros.types import installed_class
from tests.ros_child import RosProcess, own_stdout, spin_until_stdin_ends


class Subscriber(RosProcess):
    """`Subscriber("imu_data", "comms/msg/ImuSensorInformation", "--transient-local")`; close it."""

    def __init__(self, topic: str, type_name: str, *options: str) -> None:
        super().__init__(__file__, topic, type_name, *options)


def wait_until(condition: Callable[[], object]) -> None:
    deadline = monotonic() + 20
    while not condition():
        assert monotonic() < deadline, "it never happened"
        sleep(0.01)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("type")
    parser.add_argument("--transient-local", action="store_true")
    parser.add_argument("--best-effort", action="store_true")
    arguments = parser.parse_args()
    lines = own_stdout()
    qos = QoSProfile(
        depth=100,
        reliability=ReliabilityPolicy.BEST_EFFORT if arguments.best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if arguments.transient_local else DurabilityPolicy.VOLATILE,
    )
    rclpy.init(args=[])
    node = rclpy.create_node("peer")

    def on_matched(status: Any) -> None:
        if status.current_count_change > 0:  # not where a publisher of an earlier test is found to be gone
            print("matched", file=lines)

    node.create_subscription(
        installed_class(arguments.type),
        arguments.topic,
        lambda data: print(data.hex(), file=lines),
        qos,
        raw=True,
        event_callbacks=SubscriptionEventCallbacks(matched=on_matched),
    )
    spin_until_stdin_ends(node)


if __name__ == "__main__":
    main()

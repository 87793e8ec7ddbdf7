"""A ROS publisher or subscriber in a separate process: `Publisher` and `Subscriber` start this file as a script.

The publisher prints "matched" for each subscriber that it finds, and publishes each line of stdin (a message's bytes in
hex). After an empty line it prints "acknowledged" when subscribers have all messages. The subscriber prints "matched"
for each publisher that it finds, and each message's bytes in hex. Both exit when stdin ends.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parents[2]))  # sys.path of a script lacks the repository's root

from router.ros.types import installed_class
from tests.readable import readable
from tests.ros_child import RosProcess, own_stdout, spin_until_stdin_ends


class Publisher(RosProcess):
    """`Publisher("arm_target", "comms/msg/ArmBoardTargetMovement", "--best-effort")`; close it.

    With `--flood` it publishes the last message again and again.
    """

    def __init__(self, topic: str, type_name: str, *options: str) -> None:
        super().__init__(__file__, "publish", topic, type_name, *options)

    def publish(self, messages: Iterable[bytes]) -> None:
        """Publish messages, as CDR bytes, in this order."""
        self.process.stdin.writelines(f"{cdr.hex()}\n" for cdr in messages)
        self.process.stdin.flush()

    def await_receipt(self) -> None:
        """Wait until subscribers have received all messages, at least in their queues."""
        self.publish([b""])
        assert self.line() == "acknowledged"


class Subscriber(RosProcess):
    """`Subscriber("imu_data", "comms/msg/ImuSensorInformation", "--transient-local")`; close it."""

    def __init__(self, topic: str, type_name: str, *options: str) -> None:
        super().__init__(__file__, "subscribe", topic, type_name, *options)


def wait_until(condition: Callable[[], object]) -> None:
    deadline = monotonic() + 20
    while not condition():
        assert monotonic() < deadline, "it never happened"
        sleep(0.01)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=("publish", "subscribe"))
    parser.add_argument("topic")
    parser.add_argument("type")
    parser.add_argument("--transient-local", action="store_true")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--depth", type=int, default=1000)
    parser.add_argument("--flood", action="store_true")
    arguments = parser.parse_args()
    lines = own_stdout()
    qos = QoSProfile(
        depth=arguments.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if arguments.best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if arguments.transient_local else DurabilityPolicy.VOLATILE,
    )
    rclpy.init(args=[])
    node = rclpy.create_node("peer")

    def on_matched(status: Any) -> None:
        if status.current_count_change > 0:  # not when a peer of an earlier test disappears
            # A subscriber discovers a publisher later, and earlier messages have to be resent to it.
            sleep(0.1 if arguments.role == "publish" else 0)
            for _ in range(status.current_count_change):
                print("matched", file=lines)

    if arguments.role == "subscribe":
        node.create_subscription(
            installed_class(arguments.type),
            arguments.topic,
            lambda data: print(data.hex(), file=lines),
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(matched=on_matched),
        )
        spin_until_stdin_ends(node)
        return
    publisher = node.create_publisher(
        installed_class(arguments.type),
        arguments.topic,
        qos,
        event_callbacks=PublisherEventCallbacks(matched=on_matched),
    )

    def publish(line: str) -> None:
        if not line and publisher.wait_for_all_acked(Duration(seconds=20)):
            print("acknowledged", file=lines)
        if line:
            publisher.publish(bytes.fromhex(line))
        while arguments.flood and not readable(sys.stdin.fileno()):
            publisher.publish(bytes.fromhex(line))

    spin_until_stdin_ends(node, publish)


if __name__ == "__main__":
    main()

"""A ROS publisher or subscriber in a process of its own: `Publisher` and `Subscriber` start it, this file is it.

The publisher prints "matched" for each subscriber that it finds, publishes each line of its standard input (a message's
bytes in hex), prints "acknowledged" at an empty line when subscribers have all of it. The subscriber prints "matched"
for each publisher that it finds, and each message's bytes in hex. Both end with their standard input.
"""

from __future__ import annotations

import argparse
import select
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parents[2]))  # a script is not started from the repository's root

from router.ros.types import installed_class
from tests.ros_child import RosProcess, own_stdout, spin_until_stdin_ends


class Publisher(RosProcess):
    """`Publisher("arm_target", "comms/msg/ArmBoardTargetMovement", "--best-effort")`; close it.

    With `--flood` it publishes what it was last told over and over.
    """

    def __init__(self, topic: str, type_name: str, *options: str) -> None:
        super().__init__(__file__, "publish", topic, type_name, *options)

    def publish(self, messages: Iterable[bytes]) -> None:
        """CDR bytes, in this order."""
        self.process.stdin.writelines(f"{cdr.hex()}\n" for cdr in messages)
        self.process.stdin.flush()

    def await_receipt(self) -> None:
        """Subscribers have all that was published when this returns, in their queues at least."""
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
        if status.current_count_change > 0:  # not where a peer of an earlier test is found to be gone
            # A subscriber learns of a publisher later; what it misses until then has to be repaired.
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
        while arguments.flood and not select.select([sys.stdin], [], [], 0)[0]:
            publisher.publish(bytes.fromhex(line))

    spin_until_stdin_ends(node, publish)


if __name__ == "__main__":
    main()

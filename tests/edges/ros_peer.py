"""The other side of the ROS edge's tests, in a process of its own: subscribes, and prints each message's bytes in hex.

    python ros_peer.py TOPIC TYPE [--best-effort | --transient-local]

Prints "matched" once a publisher is there; ends when its standard input does.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import threading

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("type")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--transient-local", action="store_true")
    arguments = parser.parse_args()
    package, _, name = arguments.type.split("/")
    qos = QoSProfile(
        depth=100,
        reliability=ReliabilityPolicy.BEST_EFFORT if arguments.best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if arguments.transient_local else DurabilityPolicy.VOLATILE,
    )
    rclpy.init(args=[])
    node = rclpy.create_node("peer")
    node.create_subscription(
        getattr(importlib.import_module(f"{package}.msg"), name),
        arguments.topic,
        lambda data: print(data.hex(), flush=True),
        qos,
        raw=True,
        event_callbacks=SubscriptionEventCallbacks(matched=lambda _: print("matched", flush=True)),
    )
    threading.Thread(target=lambda: (sys.stdin.read(), rclpy.shutdown()), daemon=True).start()
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        node.destroy_node()


if __name__ == "__main__":
    main()

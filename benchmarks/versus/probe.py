"""The ROS side of a measurement: a subscriber, or a paced publisher. A program of its own, and knows nothing else.

    python -m benchmarks.versus.probe subscribe imu_data:comms/msg/ImuSensorInformation ...
    python -m benchmarks.versus.probe first imu_data:comms/msg/ImuSensorInformation
    python -m benchmarks.versus.probe publish --rate 1000 --seconds 5

They print {"matched": true} once the other side is there, `first` as soon as it is ready for it, and one line of JSON
with the result at the end. Messages are taken and published as bytes, in a loop around a bare wait set: rclpy's
executor and message objects cost several times what is to be measured, on the core that generator and sink share.
"""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

QUEUE_DEPTH = 10
PATIENT_DEPTH = 1000  # of the subscriber, which is a measuring instrument: it may be late, but must not miss any
DISCOVERY_SECONDS = 30
GPS_TYPE = "comms/msg/SensorBoardGPSInfo"
GPS_STAMP_OFFSET = 4 + 48  # CDR header, then utc_timestamp after 43 bytes of fields, aligned to 8
OUTBOUND = "arm_target", "comms/msg/ArmBoardTargetMovement"


def message_class(name: str) -> Any:
    package, _, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), message)


def say(**result: object) -> None:
    print(json.dumps(result), flush=True)


def wait_for(count: Callable[[str], int], topics: Iterable[str]) -> None:
    """Returns when every topic has somebody at its other end."""
    deadline = time.monotonic() + DISCOVERY_SECONDS
    while missing := [topic for topic in topics if not count(topic)]:
        if time.monotonic() > deadline:
            sys.exit(f"nobody at the other end of {', '.join(missing)}")
        time.sleep(0.05)
    say(matched=True)


def quantiles_us(samples_ns: Iterable[int]) -> dict[str, float] | None:
    """As the sink tells them."""
    ordered = sorted(samples_ns)
    if not ordered:
        return None
    points = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
    values = {name: round(ordered[round((len(ordered) - 1) * q)] / 1e3, 1) for name, q in points.items()}
    return {"n": len(ordered)} | values


def subscribe(node: Node, topics: Mapping[str, str]) -> None:
    """On SIGUSR1 and, at the end, on SIGTERM: tells what came since it told that the last time.

    Messages of GPS_TYPE are expected to carry the time of sending in utc_timestamp.
    """
    running, received = True, 0

    def stop(*_: object) -> None:
        nonlocal running
        running = False

    def tell(*_: object) -> None:
        nonlocal received
        say(received=received, latency_us=quantiles_us(latencies))
        received = 0
        latencies.clear()

    latencies: list[int] = []
    subscriptions = [
        node.create_subscription(message_class(kind), topic, lambda _: None, PATIENT_DEPTH, raw=True)
        for topic, kind in topics.items()
    ]
    taking = [
        (subscription.handle, subscription.msg_type, kind == GPS_TYPE)
        for subscription, kind in zip(subscriptions, topics.values(), strict=True)
    ]
    signal.signal(signal.SIGUSR1, tell)
    wait_for(node.count_publishers, topics)
    signal.signal(signal.SIGTERM, stop)
    wait_set = rclpy_implementation.WaitSet(len(topics), 0, 0, 0, 0, 0, node.context.handle)
    while running:
        wait_set.clear_entities()
        for handle, _, _ in taking:
            wait_set.add_subscription(handle)
        wait_set.wait(100_000_000)
        for handle, kind, is_stamped in taking:
            while (taken := handle.take_message(kind, True)) is not None:
                received += 1
                if is_stamped:
                    sent_at = struct.unpack_from("<q", taken[0], GPS_STAMP_OFFSET)[0]
                    latencies.append(time.monotonic_ns() - sent_at)
    tell()


def first(node: Node, topic: str, kind: str) -> None:
    """Tells when a message comes. Its publisher may be there or not."""
    subscription = node.create_subscription(message_class(kind), topic, lambda _: None, PATIENT_DEPTH, raw=True)
    wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
    say(matched=True)
    while subscription.handle.take_message(subscription.msg_type, True) is None:
        wait_set.clear_entities()
        wait_set.add_subscription(subscription.handle)
        wait_set.wait(100_000_000)
    say(received=1)
    signal.pause()


def publish(node: Node, rate: float, seconds: float) -> None:
    """Publishes on an absolute schedule, once a line arrives on stdin."""
    topic, kind = OUTBOUND
    message = message_class(kind)()
    for field, field_type in message.get_fields_and_field_types().items():
        if field_type == "float":
            setattr(message, field, 1.5)  # protobuf leaves out zeros; a real message has few
    sender = node.create_publisher(type(message), topic, QUEUE_DEPTH)
    data = serialize_message(message)
    wait_for(node.count_subscribers, [topic])
    sys.stdin.readline()
    start, count = time.monotonic(), round(rate * seconds)
    for number in range(count):
        if (early := start + number / rate - time.monotonic()) > 0:
            time.sleep(early)
        sender.publish(data)
    elapsed = time.monotonic() - start
    time.sleep(0.2)  # a publisher that leaves takes its unacknowledged messages with it
    say(sent=count, rate=count / elapsed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    modes = parser.add_subparsers(dest="mode", required=True)
    modes.add_parser("subscribe").add_argument("topics", nargs="+", metavar="TOPIC:TYPE")
    modes.add_parser("first").add_argument("topic", metavar="TOPIC:TYPE")
    publishing = modes.add_parser("publish")
    publishing.add_argument("--rate", type=float, required=True)
    publishing.add_argument("--seconds", type=float, required=True)
    args = parser.parse_args()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("bench_probe", start_parameter_services=False, enable_rosout=False)
    if args.mode == "subscribe":
        subscribe(node, dict(topic.split(":") for topic in args.topics))
    elif args.mode == "first":
        first(node, *args.topic.split(":"))
    else:
        publish(node, args.rate, args.seconds)
    node.destroy_node()  # leaving silently would keep the subject waiting for acknowledgements
    rclpy.shutdown()


if __name__ == "__main__":
    main()

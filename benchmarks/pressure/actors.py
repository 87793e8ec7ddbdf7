"""Who plays in a run, each a process of its own that answers in lines of JSON.

    python -m benchmarks.pressure.actors commander TIMES LOG
    python -m benchmarks.pressure.actors camera
    python -m benchmarks.pressure.actors viewer PORT
    python -m benchmarks.pressure.actors subscriber

The commander waits for a subscriber and then for a line on its input. The others work until they are ended, and on
SIGUSR1 tell how many messages they published or got since they told that the last time.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.pressure.tables import COMMAND_TOPIC, IMAGE_TOPIC, SHARED_MEMORY
from benchmarks.versus.probe import message_class, say, wait_for

IMAGE_HZ = 10
WIDTH, HEIGHT = 1000, 667
"""Of three bytes each: 2 MB."""

PUBLISHED_TOPIC = "imu_data"
"""One of those that the router publishes."""

REALTIME_PRIORITY = 10


def commander(times: str, log: str) -> None:
    """Publishes numbered commands at `times` (seconds after the line came); logs when it did, ns of the wall clock."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITY))
    # So that its own calls do not wait for subscribers that cannot be reached by shared memory.
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
    node = _node("commander")
    from comms.msg import DrivingBoardMotorMessage

    publisher = node.create_publisher(DrivingBoardMotorMessage, COMMAND_TOPIC, 10)
    due = json.loads(Path(times).read_text())
    wait_for(node.count_subscribers, [COMMAND_TOPIC])
    sys.stdin.readline()
    began, sent = time.monotonic(), []
    for number, at in enumerate(due, 1):
        message = DrivingBoardMotorMessage(distance_to_go=float(number))
        time.sleep(max(0.0, began + at - time.monotonic()))
        sent.append(time.time_ns())
        publisher.publish(message)
    Path(log).write_text(json.dumps(sent))
    time.sleep(0.5)  # a publisher that leaves takes its unacknowledged messages with it
    say(sent=len(sent))


def camera() -> None:
    node = _node("camera")
    from sensor_msgs.msg import Image

    publisher = node.create_publisher(Image, IMAGE_TOPIC, 1)
    image = Image(width=WIDTH, height=HEIGHT, step=3 * WIDTH, encoding="rgb8", data=os.urandom(3 * WIDTH * HEIGHT))
    counter = _Counter()
    say(ready=True)
    while True:
        publisher.publish(image)
        counter.count += 1
        time.sleep(1 / IMAGE_HZ)


def viewer(port: str) -> None:
    """Reads all that a gateway sends it; what is longer than an image's bytes is an image."""
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{port}", max_size=None, compression=None) as connection:
        counter = _Counter()
        say(ready=True)
        for message in connection:
            counter.count += len(message) > 3 * WIDTH * HEIGHT


def subscriber() -> None:
    """Subscribes to all that is published, as a gateway does: reliably where each publisher is reliable."""
    node = _node("subscriber")
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    counter = _Counter()

    def count(_: bytes) -> None:
        counter.count += 1

    while not node.count_publishers(PUBLISHED_TOPIC):
        time.sleep(0.05)
    time.sleep(1.0)  # the others are found meanwhile
    for topic, [kind, *_] in node.get_topic_names_and_types():
        ways = {info.qos_profile.reliability for info in node.get_publishers_info_by_topic(topic)}
        reliability = (
            ReliabilityPolicy.RELIABLE if ways == {ReliabilityPolicy.RELIABLE} else ReliabilityPolicy.BEST_EFFORT
        )
        node.create_subscription(
            message_class(kind), topic, count, QoSProfile(depth=10, reliability=reliability), raw=True
        )
    say(subscriptions=len([*node.subscriptions]), shared_memory=SHARED_MEMORY.stat().st_dev)
    while True:  # and not spin: where nothing comes, it would let no signal through
        rclpy.spin_once(node, timeout_sec=0.1)


class _Counter:
    """Tells `count` on SIGUSR1 and begins anew."""

    def __init__(self) -> None:
        self.count = 0
        signal.signal(signal.SIGUSR1, self._tell)

    def _tell(self, *_: object) -> None:
        say(count=self.count)
        self.count = 0


def _node(name: str) -> Any:
    import rclpy

    rclpy.init(args=[])
    return rclpy.create_node(name, start_parameter_services=False, enable_rosout=False)


ACTORS: dict[str, Callable[..., None]] = {
    "commander": commander,
    "camera": camera,
    "viewer": viewer,
    "subscriber": subscriber,
}

if __name__ == "__main__":
    ACTORS[sys.argv[1]](*sys.argv[2:])

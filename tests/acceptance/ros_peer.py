"""ROS software in a process of its own: `RosPeer` starts it, and this file run as a script is it.

It subscribes to topics, decodes what arrives with rclpy, and prints one JSON object a line: {"matched": topic}
when a publisher is there, {"topic": ..., "message": {...}} for a message. It ends with its standard input.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from queue import Queue
from typing import Any

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # a script is not started from the repository's root

from tests.ros_child import own_stdout, spin_until_stdin_ends

PATIENCE = 20
"""Seconds that something may take on a busy machine."""

Arrival = tuple[str, dict[str, Any]]
"""A topic, and the message as nested dictionaries and lists."""


class RosPeer:
    """`with RosPeer({"imu_data": "comms/msg/ImuSensorInformation"}) as peer:`; each topic has its publisher by then."""

    def __init__(self, topics: Mapping[str, str]) -> None:
        command = [sys.executable, __file__, json.dumps(dict(topics))]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lines: Queue[dict[str, Any]] = Queue()
        self._reader = threading.Thread(target=self._read)
        self._unmatched = set(topics)

    def __enter__(self) -> RosPeer:
        self._reader.start()
        while self._unmatched:
            self._unmatched.discard(self._lines.get(timeout=PATIENCE)["matched"])
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait(PATIENCE)
        self._reader.join(PATIENCE)
        assert self._process.returncode == 0

    def _read(self) -> None:
        assert self._process.stdout
        with self._process.stdout:
            for line in self._process.stdout:
                self._lines.put(json.loads(line))

    def receive(self) -> Arrival:
        """The next message, whatever its topic; waits for it. That a topic has another publisher is no message."""
        while "matched" in (line := self._lines.get(timeout=PATIENCE)):
            pass
        return line["topic"], line["message"]

    def nothing_left(self) -> bool:
        return self._lines.empty()


def _plain(value: Any) -> Any:
    """A message as what JSON can say; NaN and infinity in Python's way."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, list):
        return [_plain(element) for element in value]
    return value.tolist() if hasattr(value, "tolist") else value


class _Lines:
    """What the script says, a JSON object a line."""

    def __init__(self) -> None:
        self._out = own_stdout()

    def say(self, **line: object) -> None:
        print(json.dumps(line), file=self._out)


def _subscribe(node: Node, topic: str, type_name: str, lines: _Lines) -> None:
    package, _, name = type_name.split("/")
    # Those topics of the rover that are not of `comms` are offered as sensors' are: best effort.
    reliability = ReliabilityPolicy.RELIABLE if package == "comms" else ReliabilityPolicy.BEST_EFFORT
    node.create_subscription(
        getattr(importlib.import_module(f"{package}.msg"), name),
        topic,
        lambda message: lines.say(topic=topic, message=_plain(message)),
        QoSProfile(depth=1000, reliability=reliability),
        event_callbacks=SubscriptionEventCallbacks(matched=partial(_matched, topic, lines)),
    )


def _matched(topic: str, lines: _Lines, status: Any) -> None:
    if status.current_count:
        lines.say(matched=topic)


def main() -> None:
    lines = _Lines()
    rclpy.init(args=[])
    node = rclpy.create_node("acceptance_peer")
    for topic, type_name in json.loads(sys.argv[1]).items():
        _subscribe(node, topic, type_name, lines)
    spin_until_stdin_ends(node)


if __name__ == "__main__":
    main()

"""A ROS node in a separate process: `RosPeer` starts this file as a script.

Commands come on standard input and lines go to standard output, each a JSON object: {"matched": topic} when a topic has
a publisher, {"topic": ..., "message": {...}} for a message, {"result": ...} for a command. It exits when stdin ends.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from queue import Queue
from time import monotonic, sleep
from typing import Any, cast

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # sys.path of a script lacks the repository's root

from tests.compiler.ros_objects import message_class, to_object, to_value
from tests.ros_child import ForkedProcess, own_stdout, spin_until_stdin_ends

PATIENCE = 60
"""Timeout in seconds, for a busy computer."""

Arrival = tuple[str, dict[str, Any]]
"""A topic, and the message as nested dictionaries and lists."""


class RosPeer:
    """`with RosPeer({"imu_data": "comms/msg/ImuSensorInformation"}) as peer:`; each topic has its publisher by then.

    It publishes as well. A topic may have several publishers, each with a name; without one it is the topic's.
    `environment` is what its own differs in: then nothing is loaded before.
    """

    def __init__(
        self, topics: Mapping[str, str] | None = None, *, environment: Mapping[str, str] | None = None
    ) -> None:
        arguments = __file__, json.dumps(dict(topics or {}))
        self._process = _alone(arguments, environment) if environment else ForkedProcess(*arguments)
        self._arrivals: Queue[Arrival] = Queue()
        self._results: Queue[Any] = Queue()
        self._matches: Queue[str] = Queue()
        self._reader = threading.Thread(target=self._read)
        self._unmatched = set(topics or {})

    def __enter__(self) -> RosPeer:
        self._reader.start()
        while self._unmatched:
            self._unmatched.discard(self._matches.get(timeout=PATIENCE))
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        self._process.wait(PATIENCE)
        self._reader.join(PATIENCE)
        assert self._process.returncode == 0

    def _read(self) -> None:
        with self._process.stdout:
            for line in map(json.loads, self._process.stdout):
                if "result" in line:
                    self._results.put(line["result"])
                elif "matched" in line:
                    self._matches.put(line["matched"])
                else:
                    self._arrivals.put((line["topic"], line["message"]))

    def receive(self) -> Arrival:
        """Wait for the next message of any topic."""
        return self._arrivals.get(timeout=PATIENCE)

    def receive_on(self, topic: str) -> dict[str, Any]:
        """Wait for the next message of a topic, and drop earlier messages of other topics."""
        deadline = monotonic() + PATIENCE
        while (arrival := self.receive())[0] != topic:
            assert monotonic() < deadline, f"nothing on {topic}"
        return arrival[1]

    def nothing_left(self) -> bool:
        return self._arrivals.empty()

    def open(
        self,
        topic: str,
        type_name: str,
        *,
        reliable: bool = True,
        keeps: bool = False,
        name: str = "",
        depth: int = 100,
    ) -> None:
        self._ask("open", name or topic, topic=topic, type=type_name, reliable=reliable, keeps=keeps, depth=depth)

    def open_heard(self, topics: Mapping[str, str]) -> None:
        """Open reliable publishers, and wait until each has a subscriber."""
        for topic, type_name in topics.items():
            self.open(topic, type_name)
        deadline = monotonic() + PATIENCE
        while not all(map(self.heard_by, topics)):
            assert monotonic() < deadline, "nobody subscribes"
            sleep(0.01)

    def say(self, name: str, *messages: Mapping[str, Any], times: int = 1) -> None:
        """Publish messages in this order, `times` times. Omitted fields have their defaults."""
        self._ask("say", name, messages=messages * times)

    def close(self, name: str) -> None:
        self._ask("close", name)

    def heard_by(self, name: str) -> int:
        """The number of subscriptions of a topic."""
        return int(self._ask("heard_by", name))

    def _ask(self, command: str, name: str, **details: object) -> Any:
        self._process.stdin.write(json.dumps({"command": command, "name": name, **details}) + "\n")
        self._process.stdin.flush()
        return self._results.get(timeout=PATIENCE)


def _alone(arguments: tuple[str, str], environment: Mapping[str, str]) -> ForkedProcess:
    process = subprocess.Popen(
        [sys.executable, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )
    return cast("ForkedProcess", process)  # for the methods used here


def main() -> None:
    out = own_stdout()
    rclpy.init(args=[])
    node = rclpy.create_node("acceptance_peer")
    publishers: dict[str, Any] = {}

    def tell(**line: object) -> None:
        print(json.dumps(line), file=out)

    def matched(topic: str, status: Any) -> None:
        if status.current_count:
            tell(matched=topic)

    def obey(line: str) -> None:
        asked = json.loads(line)
        name, result = asked["name"], None
        if asked["command"] == "open":
            publishers[name] = _publisher(node, asked)
        elif asked["command"] == "say":
            for message in asked["messages"]:
                publishers[name].publish(to_object(publishers[name].msg_type, message))
        elif asked["command"] == "close":
            node.destroy_publisher(publishers.pop(name))
        else:
            result = publishers[name].get_subscription_count()
        tell(result=result)

    for topic, type_name in json.loads(sys.argv[1]).items():
        # The rover publishes sensor_msgs and TwistStamped best effort.
        reliable = not type_name.startswith("sensor_msgs/") and type_name != "geometry_msgs/msg/TwistStamped"
        node.create_subscription(
            message_class(type_name),
            topic,
            lambda message, topic=topic: tell(topic=topic, message=to_value(message)),
            QoSProfile(depth=1000, reliability=_reliability(reliable)),
            event_callbacks=SubscriptionEventCallbacks(matched=partial(matched, topic)),
        )
    spin_until_stdin_ends(node, obey)


def _publisher(node: Node, asked: Mapping[str, Any]) -> Any:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if asked["keeps"] else DurabilityPolicy.VOLATILE
    qos = QoSProfile(depth=asked["depth"], reliability=_reliability(asked["reliable"]), durability=durability)
    return node.create_publisher(message_class(asked["type"]), asked["topic"], qos)


def _reliability(reliable: bool) -> ReliabilityPolicy:
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


if __name__ == "__main__":
    main()

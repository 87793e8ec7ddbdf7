"""ROS software that publishes, in a process of its own: `RosTalker` starts it, and this file run as a script is it.

It prints "matched" once each of its topics has a subscriber, publishes what each line of its standard input says
({"topic": ..., "message": {...}}) with rclpy's own classes, and ends with its standard input.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any

import rclpy
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # a script is not started from the repository's root

from tests.compiler.ros_objects import message_class, to_object
from tests.ros_child import RosProcess, own_stdout, spin_until_stdin_ends


class RosTalker(RosProcess):
    """`with RosTalker({"drive_motor": "comms/msg/DrivingBoardMotorMessage"}) as talker:`; reliable publishers."""

    def __init__(self, topics: Mapping[str, str]) -> None:
        super().__init__(__file__, json.dumps(dict(topics)))

    def __enter__(self) -> RosTalker:
        assert self.line() == "matched"
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.close()

    def publish(self, topic: str, *messages: Mapping[str, Any]) -> None:
        """In this order. Nested dictionaries and lists; a field that is left out has its default."""
        assert self.process.stdin
        self.process.stdin.writelines(f"{json.dumps({'topic': topic, 'message': values})}\n" for values in messages)
        self.process.stdin.flush()


def main() -> None:
    lines = own_stdout()
    topics = {topic: message_class(name) for topic, name in json.loads(sys.argv[1]).items()}
    rclpy.init(args=[])
    node = rclpy.create_node("acceptance_talker")
    matched = {topic: threading.Event() for topic in topics}

    def on_matched(topic: str, status: Any) -> None:
        if status.current_count > 0:
            matched[topic].set()

    publishers = {
        topic: node.create_publisher(
            message,
            topic,
            QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE),
            event_callbacks=PublisherEventCallbacks(matched=partial(on_matched, topic)),
        )
        for topic, message in topics.items()
    }

    def tell() -> None:
        for event in matched.values():
            event.wait()
        sleep(0.1)  # the subscriber learns of it later; what it misses until then takes DDS three seconds to repair
        print("matched", file=lines)

    def publish(line: str) -> None:
        said = json.loads(line)
        publishers[said["topic"]].publish(to_object(topics[said["topic"]], said["message"]))

    threading.Thread(target=tell, daemon=True).start()
    spin_until_stdin_ends(node, publish)


if __name__ == "__main__":
    main()

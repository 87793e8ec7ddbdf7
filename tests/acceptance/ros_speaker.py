"""Publishers that a test opens, uses and closes as it likes: `Speaker` starts a process, and this file run is it.

Commands and answers are JSON, one a line.
"""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # a script is not started from the repository's root

from tests.ros_child import own_stdout


class Speaker:
    """`with Speaker() as speaker: speaker.open("/pose", "geometry_msgs/msg/Pose"); speaker.say("/pose", {...})`.

    Topics may have several publishers, each with a name of its own; without one it is the topic's.
    """

    def __init__(self, node: str = "speaker") -> None:
        command = [sys.executable, __file__, node]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> Speaker:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
        self.process.communicate(timeout=20)

    def open(self, topic: str, type_name: str, *, reliable: bool = True, keeps: bool = False, name: str = "") -> None:
        self._ask("open", name or topic, topic=topic, type=type_name, reliable=reliable, keeps=keeps)

    def say(self, name: str, fields: Mapping[str, Any], *, times: int = 1) -> None:
        """One message with these fields, `times` times."""
        self._ask("say", name, fields=fields, times=times)

    def close(self, name: str) -> None:
        self._ask("close", name)

    def heard_by(self, name: str) -> int:
        """How many subscriptions it has."""
        return int(self._ask("heard_by", name))

    def _ask(self, command: str, name: str, **details: object) -> Any:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps({"command": command, "name": name, **details}) + "\n")
        self.process.stdin.flush()
        answer = json.loads(self.process.stdout.readline())
        assert "error" not in answer, answer
        return answer["result"]


def _fill(message: Any, fields: Mapping[str, Any]) -> Any:
    types = message.get_fields_and_field_types()
    for name, value in fields.items():
        if isinstance(value, dict):
            _fill(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            package, _, short = types[name].removeprefix("sequence<").partition(">")[0].partition("/")
            element = getattr(importlib.import_module(f"{package}.msg"), short)
            setattr(message, name, [_fill(element(), each) for each in value])
        else:
            setattr(message, name, value)
    return message


def main() -> None:
    answers = own_stdout()
    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    classes: dict[str, Any] = {}
    publishers: dict[str, Any] = {}
    for line in sys.stdin:
        asked = json.loads(line)
        name = asked["name"]
        result: object = None
        if asked["command"] == "open":
            package, _, short = asked["type"].split("/")
            classes[name] = getattr(importlib.import_module(f"{package}.msg"), short)
            qos = QoSProfile(
                depth=100,
                reliability=ReliabilityPolicy.RELIABLE if asked["reliable"] else ReliabilityPolicy.BEST_EFFORT,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if asked["keeps"] else DurabilityPolicy.VOLATILE,
            )
            publishers[name] = node.create_publisher(classes[name], asked["topic"], qos)
        elif asked["command"] == "say":
            message = _fill(classes[name](), asked["fields"])
            for _ in range(asked["times"]):
                publishers[name].publish(message)
        elif asked["command"] == "close":
            node.destroy_publisher(publishers.pop(name))
        else:
            result = publishers[name].get_subscription_count()
        print(json.dumps({"result": result}), file=answers, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()

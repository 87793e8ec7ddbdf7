"""Clients of services in a separate process: `ServiceClients` starts this file as a script.

Each line on standard input is a call, a JSON object: {"number": 1, "service": "/arm", "type": "std_srvs/srv/SetBool",
"request": {"data": true}}. Each response is a line on standard output: {"number": 1, "response": {"success": true}}.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from queue import Queue
from time import monotonic, sleep
from typing import Any, NamedTuple

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import QoSProfile

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # sys.path of a script lacks the repository's root

from tests.acceptance.ros_peer import PATIENCE
from tests.compiler.ros_objects import to_value
from tests.ros_child import ForkedProcess, own_stdout, spin_until_stdin_ends


class Service(NamedTuple):
    """A service by its name and type."""

    name: str
    type: str


ARM = Service("arm", "std_srvs/srv/SetBool")


class ServiceClients:
    """`with ServiceClients() as clients: clients.call(ARM, {"data": True})`."""

    def __init__(self) -> None:
        self._process = ForkedProcess(__file__)
        self._reader = threading.Thread(target=self._read)
        self._numbers = count(1)
        self._responses: dict[int, Queue[Any]] = {}

    def __enter__(self) -> ServiceClients:
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        self._process.wait(PATIENCE)
        self._reader.join(PATIENCE)
        assert self._process.returncode == 0

    def _read(self) -> None:
        with self._process.stdout:
            for line in map(json.loads, self._process.stdout):
                self._responses[line["number"]].put(line["response"])

    def begin(self, service: Service, request: Mapping[str, Any] | None = None) -> Queue[Any]:
        """Call, and return the queue that gets the response. The client waits for the service first."""
        number, response = next(self._numbers), Queue[Any]()
        self._responses[number] = response
        call = {"number": number, "service": service.name, "type": service.type, "request": request or {}}
        self._process.stdin.write(json.dumps(call) + "\n")
        self._process.stdin.flush()
        return response

    def call(self, service: Service, request: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Call, and return the response."""
        response: dict[str, Any] = self.begin(service, request).get(timeout=PATIENCE)
        return response


def main() -> None:
    out = own_stdout()
    rclpy.init(args=[])
    node = rclpy.create_node("service_clients")
    group = ReentrantCallbackGroup()
    clients: dict[tuple[str, str], Any] = {}

    def called(line: str) -> None:
        asked = json.loads(line)
        key = asked["service"], asked["type"]
        package, _, name = asked["type"].split("/")
        service = getattr(importlib.import_module(f"{package}.srv"), name)
        if key not in clients:
            qos = QoSProfile(depth=1000)  # by default, 10 responses wait
            clients[key] = node.create_client(service, asked["service"], qos_profile=qos, callback_group=group)
        until = monotonic() + PATIENCE
        while not clients[key].service_is_ready():
            assert monotonic() < until, f"there is no service {asked['service']}"
            sleep(0.01)
        request = service.Request(**asked["request"])

        def answered(future: Any) -> None:
            print(json.dumps({"number": asked["number"], "response": to_value(future.result())}), file=out)

        clients[key].call_async(request).add_done_callback(answered)

    spin_until_stdin_ends(node, called)


if __name__ == "__main__":
    main()

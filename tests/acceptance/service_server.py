"""A server of std_srvs/srv/SetBool in a separate process: `ServiceServer` starts this file as a script.

Each line on standard input is how long it waits before it responds, in seconds; at first it does not wait. Each request
is a line on standard output.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import sleep
from typing import Any

import rclpy

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # sys.path of a script lacks the repository's root

from tests.ros_child import RosProcess, own_stdout, spin_until_stdin_ends


class ServiceServer:
    """`with ServiceServer("get_home") as server:`; it responds with the request's data, and the text `here`."""

    def __init__(self, name: str) -> None:
        self._process = RosProcess(__file__, name)

    def __enter__(self) -> ServiceServer:
        assert self._process.line() == "ready"
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._process.process.poll() is None:
            self._process.close()

    def wait(self, seconds: float) -> None:
        """Wait before each response from now on, and forget earlier requests."""
        self._process.process.stdin.write(f"{seconds}\n")
        self._process.process.stdin.flush()
        while (line := self._process.line()) != "waiting":
            assert line in ("True", "False")

    def request(self) -> str:
        """Wait for the next request and return its data."""
        return self._process.line()

    def kill(self) -> None:
        self._process.kill()


def main() -> None:
    from std_srvs.srv import SetBool  # type: ignore[import-untyped]

    out = own_stdout()
    rclpy.init(args=[])
    node = rclpy.create_node("service_server")
    delay = 0.0

    def respond(request: Any, response: Any) -> Any:
        print(request.data, file=out)
        sleep(delay)
        response.success, response.message = request.data, "here"
        return response

    def heard(line: str) -> None:
        nonlocal delay
        delay = float(line)
        print("waiting", file=out)

    node.create_service(SetBool, sys.argv[1], respond)
    print("ready", file=out)
    spin_until_stdin_ends(node, heard)


if __name__ == "__main__":
    main()

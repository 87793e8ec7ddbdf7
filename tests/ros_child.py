"""ROS child processes of tests: `RosProcess` is the test's handle; the other functions run in the child.

Importing rclpy takes most of a child's start. So each test process has a forker (this file run as a script), which has
imported rclpy and forks the children.
"""

from __future__ import annotations

import fcntl
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TextIO

_LARGEST_REQUEST = 1 << 20

_PIPE = 1 << 20
"""Bytes that a child can print before the test reads: a blocked child loses messages."""


_PATIENCE = 60


class ForkedProcess:
    """A child of the forker, with the part of `subprocess.Popen`'s interface that tests use."""

    def __init__(self, *command: str) -> None:
        stdin, self._to_stdin = os.pipe()
        from_stdout, stdout = os.pipe()
        fcntl.fcntl(stdout, fcntl.F_SETPIPE_SZ, _PIPE)
        environment = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_suffix(".xml")), **os.environ}
        request = {"command": command, "environment": environment, "folder": str(Path.cwd())}
        self.pid: int = _ask(request, stdin, stdout)
        os.close(stdin)
        os.close(stdout)
        self.stdin, self.stdout = open(self._to_stdin, "w"), open(from_stdout)  # noqa: SIM115, PTH123
        self.returncode: int | None = None
        self._pidfd = os.pidfd_open(self.pid)

    def poll(self) -> int | None:
        if self.returncode is None and self._has_ended(0):
            self.returncode = _ask({"wait": self.pid})
            os.close(self._pidfd)
        return self.returncode

    def wait(self, timeout: float = 60) -> int:
        assert self.returncode is not None or self._has_ended(timeout), "it does not end"
        code = self.poll()
        assert code is not None
        return code

    def _has_ended(self, timeout: float) -> bool:
        from tests.readable import readable  # this file is also the forker, which cannot import `tests`

        return readable(self._pidfd, timeout)

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            signal.pidfd_send_signal(self._pidfd, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self) -> str:
        """Close the child's stdin, wait for it to exit, and return the remaining output."""
        if self.stdout.closed:
            return ""
        self.stdin.close()
        rest = self.stdout.read()
        self.wait()
        self.stdout.close()
        return rest


class RosProcess:
    """A running child with a line protocol on stdin and stdout. Close it after use."""

    def __init__(self, script: str, *arguments: str) -> None:
        self.process = ForkedProcess(script, *arguments)
        self._rest = b""

    def line(self) -> str:
        """Wait for the child's next line and return it; "" at the end of its output."""
        from tests.readable import readable  # as above

        descriptor = self.process.stdout.fileno()
        while b"\n" not in self._rest:
            assert readable(descriptor, _PATIENCE), f"the child has said nothing for {_PATIENCE} s"
            if not (piece := os.read(descriptor, _PIPE)):
                break
            self._rest += piece
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode().strip()

    def kill(self) -> None:
        """Kill the child with SIGKILL, so that it does not announce its end to ROS."""
        self.process.kill()
        self.process.communicate()

    def close(self) -> None:
        self.process.communicate()
        assert self.process.returncode == 0


@cache
def _forker() -> socket.socket:
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # a fork would lose numpy's threads
    subprocess.Popen([sys.executable, __file__, str(its.fileno())], pass_fds=[its.fileno()], env=environment)
    its.close()
    return ours


def _ask(request: dict[str, Any], *descriptors: int) -> int:
    forker = _forker()
    socket.send_fds(forker, [json.dumps(request).encode()], descriptors)
    return int(forker.recv(100))


def fork_on_request(requests: socket.socket) -> None:
    """The forker's loop: fork a child per request until the parent exits."""
    while True:
        request, descriptors, _, _ = socket.recv_fds(requests, _LARGEST_REQUEST, 2)
        if not request:
            return
        asked = json.loads(request)
        if "wait" in asked:
            answer = os.waitstatus_to_exitcode(os.waitpid(asked["wait"], 0)[1])
        elif not (answer := os.fork()):
            requests.close()
            os._exit(_run(asked, *descriptors))
        for descriptor in descriptors:
            os.close(descriptor)
        requests.send(str(answer).encode())


def _run(asked: dict[str, Any], stdin: int, stdout: int) -> int:
    """Run the script of a request in this process, and return its exit code."""
    for descriptor, wanted in ((stdin, 0), (stdout, 1)):
        os.dup2(descriptor, wanted)
        os.close(descriptor)
    sys.stdin, sys.stdout = open(0), open(1, "w")  # noqa: SIM115
    os.environ.clear()
    os.environ.update(asked["environment"])
    os.chdir(asked["folder"])
    sys.argv = asked["command"]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
        sys.stdout.flush()
    except BaseException:  # noqa: BLE001 - as the interpreter does
        traceback.print_exc()
        return 1
    return 0


def own_stdout() -> TextIO:
    """The original stdout, for protocol lines only; all other output goes to stderr.

    Fast DDS writes its warnings (for example of a lock file that a killed process left in /dev/shm) to
    descriptor 1.
    """
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return lines


def spin_until_stdin_ends(node: Any, heard: Callable[[str], None] = lambda _: None) -> None:
    """Spin until stdin ends, and pass each line to `heard` on a separate thread."""
    import rclpy
    from rclpy.task import Future

    ended: Future[None] = Future()

    def listen() -> None:
        for line in sys.stdin:
            heard(line.strip())
        ended.set_result(None)  # not rclpy.shutdown(): it would destroy the context while the other thread spins

    threading.Thread(target=listen, daemon=True).start()
    rclpy.spin_until_future_complete(node, ended)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import std_msgs.msg  # noqa: F401

    import tests.compiler.ros_objects
    import tests.ros_child  # noqa: F401 - as the scripts name it

    fork_on_request(socket.socket(fileno=int(sys.argv[1])))

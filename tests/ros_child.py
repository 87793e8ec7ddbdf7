"""ROS child processes of tests: `RosProcess` is their handle in the test, the other functions serve the child.

Importing rclpy takes most of the start of such a process. One process for each test process, the forker (this file run
as a script), has imported it and forks the children.
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
"""Bytes that a child may print before somebody reads: one that has to wait loses messages."""


class ForkedProcess:
    """A child of the forker, with as much of the interface of `subprocess.Popen` as tests need."""

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
        from tests.readable import readable  # the forker, which is this file as well, has no `tests`

        return readable(self._pidfd, timeout)

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            signal.pidfd_send_signal(self._pidfd, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self) -> str:
        """End its standard input, wait for its end, and return the rest of its output."""
        if self.stdout.closed:
            return ""
        self.stdin.close()
        rest = self.stdout.read()
        self.wait()
        self.stdout.close()
        return rest


class RosProcess:
    """A running child, talked to line by line; close it."""

    def __init__(self, script: str, *arguments: str) -> None:
        self.process = ForkedProcess(script, *arguments)

    def line(self) -> str:
        """The next line that it prints; waits for it."""
        return self.process.stdout.readline().strip()

    def kill(self) -> None:
        """As `kill -9` does: ROS is told nothing."""
        self.process.kill()
        self.process.communicate()

    def close(self) -> None:
        self.process.communicate()
        assert self.process.returncode == 0


@cache
def _forker() -> socket.socket:
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # of its threads, a fork would lose those of numpy
    subprocess.Popen([sys.executable, __file__, str(its.fileno())], pass_fds=[its.fileno()], env=environment)
    its.close()
    return ours


def _ask(request: dict[str, Any], *descriptors: int) -> int:
    forker = _forker()
    socket.send_fds(forker, [json.dumps(request).encode()], descriptors)
    return int(forker.recv(100))


def fork_on_request(requests: socket.socket) -> None:
    """What the forker does, until its parent has gone."""
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
    """What was standard output, for our lines alone; everything else that is printed goes to standard error.

    Fast DDS is C++ and writes its complaints (a lock file that a killed process left in /dev/shm) to
    descriptor 1.
    """
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return lines


def spin_until_stdin_ends(node: Any, heard: Callable[[str], None] = lambda _: None) -> None:
    """Each line from standard input goes to `heard`, on a thread of its own."""
    import rclpy
    from rclpy.task import Future

    ended: Future[None] = Future()

    def listen() -> None:
        for line in sys.stdin:
            heard(line.strip())
        ended.set_result(None)  # not rclpy.shutdown(): it would pull the context from under the thread that spins

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

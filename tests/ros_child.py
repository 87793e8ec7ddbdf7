"""What ROS child processes of tests have in common: a standard output of their own, and an end with standard input.

`RosProcess` is their handle in the test.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import TextIO

import rclpy
from rclpy.node import Node
from rclpy.task import Future


class RosProcess:
    """A running child, talked to line by line; close it."""

    def __init__(self, script: str, *arguments: str) -> None:
        command = [sys.executable, script, *arguments]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def line(self) -> str:
        """The next line that it prints; waits for it."""
        assert self.process.stdout
        return self.process.stdout.readline().strip()

    def kill(self) -> None:
        """As `kill -9` does: ROS is told nothing."""
        self.process.kill()
        self.process.communicate()

    def close(self) -> None:
        self.process.communicate(timeout=20)
        assert self.process.returncode == 0


def own_stdout() -> TextIO:
    """What was standard output, for our lines alone; everything else that is printed goes to standard error.

    Fast DDS is C++ and writes its complaints (a lock file that a killed process left in /dev/shm) to
    descriptor 1.
    """
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return lines


def spin_until_stdin_ends(node: Node, heard: Callable[[str], None] = lambda _: None) -> None:
    """Each line from standard input goes to `heard`, on a thread of its own."""

    ended: Future[None] = Future()

    def listen() -> None:
        for line in sys.stdin:
            heard(line.strip())
        ended.set_result(None)  # not rclpy.shutdown(): it would pull the context from under the thread that spins

    threading.Thread(target=listen, daemon=True).start()
    rclpy.spin_until_future_complete(node, ended)
    node.destroy_node()
    rclpy.shutdown()

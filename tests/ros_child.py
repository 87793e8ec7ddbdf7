"""What ROS child processes of tests have in common: a standard output of their own, and an end with standard input."""

from __future__ import annotations

import os
import sys
import threading
from typing import TextIO

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node


def own_stdout() -> TextIO:
    """What was standard output, for our lines alone; everything else that is printed goes to standard error.

    Fast DDS is C++ and writes its complaints (a lock file that a killed process left in /dev/shm) to
    descriptor 1.
    """
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return lines


def spin_until_stdin_ends(node: Node) -> None:
    threading.Thread(target=lambda: (sys.stdin.read(), rclpy.shutdown()), daemon=True).start()
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        node.destroy_node()

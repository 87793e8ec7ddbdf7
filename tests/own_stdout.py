"""For a test's child process whose standard output is a protocol: keeps what the ROS middleware prints out of it."""

from __future__ import annotations

import os
from typing import TextIO


def own_stdout() -> TextIO:
    """What was standard output, for our lines alone; everything else that is printed goes to standard error.

    Fast DDS is C++ and writes its complaints (a lock file that a killed process left in /dev/shm) to
    descriptor 1.
    """
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return lines

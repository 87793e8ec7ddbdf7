"""A lane for each process that runs tests: a ROS domain and ports that no other test process on this network uses."""

from __future__ import annotations

import errno
import socket

LANES = 50


def _claim() -> int:
    """Bind the name of the first free lane for as long as this process lives.

    A name in Linux's abstract namespace belongs to the network namespace, as domains and ports do: a container that
    shares the network, but no file, sees it.
    """
    for lane in range(LANES):
        held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            held.bind(f"\0router-tests-lane-{lane}")
        except OSError as error:
            held.close()
            if error.errno != errno.EADDRINUSE:
                raise
        else:
            _held.append(held)
            return lane
    raise RuntimeError(f"{LANES} processes run tests on this network already")


_held: list[socket.socket] = []
LANE = _claim()
"""From 0 up to `LANES`, exclusive."""

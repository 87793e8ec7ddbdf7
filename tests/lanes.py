"""One lane per test process: a ROS domain and ports that no other test process in this network namespace uses."""

from __future__ import annotations

import errno
import socket

LANES = 50


def _claim() -> int:
    """Bind the name of the first free lane for as long as this process lives.

    A name in Linux's abstract namespace belongs to the network namespace, as domains and ports do, so containers
    that share the network but no files see it.
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
"""This process's lane, from 0 to `LANES` - 1."""

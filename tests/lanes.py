"""A lane for each process that runs tests: a ROS domain and ports that no other test process on this machine uses."""

from __future__ import annotations

import fcntl
import tempfile
from pathlib import Path

LANES = 50


def _claim() -> int:
    """Lock the first free lane for as long as this process lives."""
    for lane in range(LANES):
        file = Path(tempfile.gettempdir(), f"router-tests-lane-{lane}").open("w", encoding="utf-8")  # noqa: SIM115
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
        else:
            _held.append(file)
            return lane
    raise RuntimeError(f"{LANES} processes run tests on this machine already")


_held: list[object] = []
LANE = _claim()
"""From 0 up to `LANES`, exclusive."""

"""What a running router has in memory: not what it might need, and nothing that only the start needed."""

from __future__ import annotations

import ctypes
import mmap
import socket
import subprocess
import sys
from importlib.util import find_spec
from typing import Any

import pytest

from router.app.counts import MOST_COUNTERS, ThreadCounts
from router.carrier.library import load
from router.carrier.ring import Ring
from tests.app.conftest import Site
from tests.ports import free_port

_mincore = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)(
    ("mincore", ctypes.CDLL(None))
)


def pages_in_memory(array: ctypes.Array[Any]) -> int:
    """How many pages of an array that begins with a page are in memory."""
    pages = (ctypes.c_ubyte * -(-ctypes.sizeof(array) // mmap.PAGESIZE))()
    assert _mincore(ctypes.addressof(array), ctypes.sizeof(array), pages) == 0
    return sum(page & 1 for page in pages)


def test_counters_that_no_table_has_take_no_memory() -> None:
    counts = ThreadCounts.fixed()
    assert len(counts) == MOST_COUNTERS
    counts[0] += 1
    counts[MOST_COUNTERS - 1] += 1
    assert pages_in_memory(counts) == 2


def test_a_ring_from_which_nothing_was_taken_has_no_buffer_in_memory() -> None:
    ring = Ring(load(), 1 << 18)
    assert len(ring.take()) == 0
    assert pages_in_memory(ring._records) == 0


ROUTER = """\
import sys
from pathlib import Path
import router.cli.run
from router.app import Router
from router.compiler import check_table

with Router(check_table(Path(sys.argv[1])).program):
    print(*sys.modules)
"""
IMU = """\
  imu_info:
    source: sensor_board
    topic: {topic: imu, type: sensor_msgs/msg/Imu, fields: {orientation_covariance: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
GATEWAY = """\
gateways:
  page: {transport: {websocket: "127.0.0.1:%d"}}
"""
UNUSED_BY_TOPICS = ("numpy", "lark", "em", "sensor_msgs.msg", "rich", "asyncio", "ssl", "_hashlib")
UNUSED_BY_GATEWAYS = ("numpy", "lark", "em", "sensor_msgs.msg", "rich")
"""Large modules that libraries would import."""


@pytest.mark.parametrize(
    ("routes", "unused"),
    [
        pytest.param(IMU, UNUSED_BY_TOPICS, id="topics"),
        pytest.param(IMU + GATEWAY % free_port(kind=socket.SOCK_STREAM), UNUSED_BY_GATEWAYS, id="gateway"),
    ],
)
def test_a_router_has_not_imported_what_it_does_not_use(site: Site, routes: str, unused: tuple[str, ...]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    assert all(map(find_spec, unused))
    ran = subprocess.run(
        [sys.executable, "-c", ROUTER, str(site.write(routes))], capture_output=True, text=True, check=True, timeout=60
    )
    assert "sensor_msgs.sensor_msgs_s__rosidl_typesupport_c" in ran.stdout.split()
    assert set(unused) & set(ran.stdout.split()) == set()

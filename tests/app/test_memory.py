"""What a running router has in memory: not what it might need, and nothing that only the start needed."""

from __future__ import annotations

import ctypes
import mmap
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from grpc_tools import _protoc_compiler

from router.app import Router
from router.app.memory import Mapping, read_only
from router.carrier.forwarding import counts_and_events
from router.carrier.ring import Ring
from router.declared import MOST_COUNTERS
from router.library import load
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
    counts, _ = counts_and_events(load(), 1)
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
from router import main
from router.cli import run

run._serve_signals = lambda *_: print(*sys.modules)
main(["run", sys.argv[1]])
"""
IMU = """\
  imu_info:
    source: sensor_board
    topic: {topic: imu, type: sensor_msgs/msg/Imu, fields: {orientation_covariance: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
GATEWAY = """\
gateways:
  page: {transport: {websocket: "127.0.0.1:PORT"}}
"""
UNUSED_BY_TOPICS = ("numpy", "sensor_msgs.msg", "asyncio", "ssl")
UNUSED_BY_GATEWAYS = ("numpy", "sensor_msgs.msg")
"""Large modules that libraries would import."""


@pytest.mark.parametrize(
    ("routes", "unused"),
    [
        pytest.param(IMU, UNUSED_BY_TOPICS, id="topics"),
        pytest.param(IMU + GATEWAY, UNUSED_BY_GATEWAYS, id="gateway"),
    ],
)
def test_a_router_has_not_imported_what_it_does_not_use(site: Site, routes: str, unused: tuple[str, ...]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    assert all(map(find_spec, unused))
    table = site.write(routes.replace("PORT", str(free_port(kind=socket.SOCK_STREAM))))
    ran = subprocess.run(
        [sys.executable, "-c", ROUTER, str(table)], capture_output=True, text=True, check=True, timeout=60
    )
    assert "sensor_msgs.sensor_msgs_s__rosidl_typesupport_c" in ran.stdout.split()
    assert set(unused) & set(ran.stdout.split()) == set()


PH = "  ph_info: {source: sensor_board, destinations: basestation}\n"


def code_in_memory() -> Iterator[int]:
    """How many KiB of each part of protoc's library that can be executed are mapped to memory."""
    smaps = re.split(r"^(?=[0-9a-f]+-)", Path("/proc/self/smaps").read_text(), flags=re.MULTILINE)
    for mapping in smaps:
        first = mapping.partition("\n")[0]
        if first.endswith(_protoc_compiler.__file__) and " r-xp " in first:
            yield int(re.findall(r"^Rss: +(\d+)", mapping, re.MULTILINE)[0])


def test_code_that_only_reloads_use_is_in_memory_only_then(site: Site) -> None:
    program = site.program(PH)
    assert sum(code_in_memory()) > 1000
    with Router(program) as router:
        assert list(code_in_memory()) == [0]
        assert router.reload().ok
        assert list(code_in_memory()) == [0]


MAPS = """\
55d0c0000000-55d0c0010000 r--p 00000000 fe:00 11 /usr/bin/python3.11
55d0c0010000-55d0c0030000 r-xp 00010000 fe:00 11 /usr/bin/python3.11
55d0c0030000-55d0c0040000 r--p 00030000 fe:00 11 /usr/bin/python3.11
55d0c0040000-55d0c0050000 rw-p 00040000 fe:00 11 /usr/bin/python3.11
55d0c1000000-55d0c1100000 rw-p 00000000 00:00 0 [heap]
7f0000000000-7f0000021000 rw-p 00000000 00:00 0
7f0000100000-7f0000101000 rw-s 00000000 00:18 7 /dev/shm/a name (deleted)
7f0000200000-7f0000203000 r-xp 00000000 fe:00 12 /opt/my rover/lib.so
"""


def test_only_what_nobody_has_written_to_may_be_dropped() -> None:
    assert list(read_only(MAPS)) == [
        Mapping(0x55D0C0000000, 0x10000, "python3.11"),
        Mapping(0x55D0C0010000, 0x20000, "python3.11"),
        Mapping(0x7F0000200000, 0x3000, "lib.so"),
    ]

"""Ports for what cannot bind port 0 itself: free, and none that the kernel gives to somebody else meanwhile."""

from __future__ import annotations

import socket
from itertools import cycle
from pathlib import Path

from tests.lanes import LANE, LANES

GIVEN_BY_KERNEL = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""Each socket that does not choose gets one of these: callers, and all that ROS sends with."""


def free_port(host: str = "127.0.0.1", kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port that nobody had a moment ago."""
    return next(port for port in _ports if _is_free(host, port, kind))


def _is_free(host: str, port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def _outside() -> list[int]:
    """The share of this process in the ports that neither the kernel nor ROS hand out."""
    first, last = map(int, GIVEN_BY_KERNEL.read_text().split())
    ports = [*range(last + 1, 65536)] or [*range(1024, min(first, 7400))]
    return ports[LANE::LANES]


_ports = cycle(_outside())
"""None comes again before all others have."""

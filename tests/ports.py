"""Free ports for programs that cannot bind port 0, outside the kernel's ephemeral range."""

from __future__ import annotations

import socket
from itertools import cycle
from pathlib import Path

from router.net.addresses import family
from tests.lanes import LANE, LANES

GIVEN_BY_KERNEL = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""The kernel's ephemeral ports: for sockets that do not bind a port, including all sending sockets of ROS."""


def free_port(host: str = "127.0.0.1", kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port that was free a moment ago."""
    return next(port for port in _ports if _is_free(host, port, kind))


def _is_free(host: str, port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(family(host), kind) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def _outside() -> list[int]:
    """This process's share of the ports that neither the kernel nor ROS assigns."""
    first, last = map(int, GIVEN_BY_KERNEL.read_text().split())
    ports = [*range(last + 1, 65536)] or [*range(1024, min(first, 7400))]
    return ports[LANE::LANES]


_ports = cycle(_outside())
"""Each port is returned again only after all others."""

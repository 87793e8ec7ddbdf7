"""The control socket of a running router: taps, reloads and saving, for the router's user and root.

It is an abstract Unix socket named after the HTTP address. It exists in that address's network namespace only, and the
kernel says which user connects, so neither a proxy nor another computer reaches it.
"""

from __future__ import annotations

import os
import socket
import struct

from router.hosts import any_of
from router.net.addresses import family, socket_address

_BACKLOG = 64
_CREDENTIALS = struct.Struct("3i")
"""struct ucred of <sys/socket.h>: process, user, group."""
_TIME = struct.Struct("2l")
"""struct timeval of <sys/time.h>: seconds, microseconds."""


def listen(host: str, port: int) -> socket.socket:
    """Return the listening control socket of a router that serves HTTP there. Raises OSError."""
    listening = socket.socket(socket.AF_UNIX)
    try:
        listening.bind(_name(host, port))
        listening.listen(_BACKLOG)
    except BaseException:
        listening.close()
        raise
    return listening


def is_by_owner(connection: socket.socket) -> bool:
    """Return whether the peer of a control socket is this process's user, or root."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _, user, _ = _CREDENTIALS.unpack(credentials)
    return user in _owners()


def _owners() -> tuple[int, ...]:
    return 0, os.geteuid()


def connect(host: str, port: int, patience: float | None) -> socket.socket:
    """Connect to the router of this computer that serves HTTP there. `host` is an IP address. Raises OSError.

    That router may serve all addresses of this computer. Waits up to `patience` (s) while other users fill its queue.
    """
    with socket.socket(family(host), socket.SOCK_DGRAM) as probe:
        probe.bind(socket_address(host, 0))  # otherwise another computer's address could mean this one's router
    connection = socket.socket(socket.AF_UNIX)
    try:
        seconds = patience or 0.0  # 0: without limit
        limit = _TIME.pack(int(seconds), int(seconds % 1 * 1e6))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)  # with Python's, a full queue is an error
        try:
            connection.connect(_name(host, port))
        except ConnectionRefusedError:
            connection.connect(_name(any_of(host), port))
        connection.settimeout(patience)
    except BaseException:
        connection.close()
        raise
    return connection


def _name(host: str, port: int) -> str:
    return f"\0rover-router/{host}:{port}"

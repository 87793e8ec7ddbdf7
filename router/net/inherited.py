"""Sockets that were bound before this process began, and are handed to it: they outlive it, with what is in them.

As systemd hands them over, sd_listen_fds(3). Knows addresses; what a socket is for, its listener says.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, MutableMapping
from functools import cache

from router.net.kernel import bound_interface
from router.table.model import Address, bound_to

FIRST = 3
"""The descriptor of the first one; the others follow it."""

SO_TIMESTAMPNS = 35
"""Of Linux, where the socket module does not name it."""


class Inherited:
    """UDP sockets by what they are bound to: an address, or an address on an interface (see `bound_to`)."""

    def __init__(self, sockets: Iterable[socket.socket] = ()) -> None:
        self._sockets = {_bound_to(each): each for each in sockets}
        self._taken: set[str] = set()

    def take(self, bound: str) -> socket.socket | None:
        """The socket that is `bound` so, as one of the caller's own, which he closes. It can be taken again.

        What is in it has the time at which the kernel got it, if the socket was told to keep that (Timestamping=ns).
        """
        held = self._sockets.get(bound)
        if held is None or _bound_to(held) != bound:  # its interface may have gone meanwhile
            return None
        self._taken.add(bound)
        # Stamps then go with each datagram instead, where nobody looks; that the kernel makes them remains.
        held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)
        held.setblocking(True)
        return held.dup()

    def unclaimed(self) -> list[str]:
        """What nobody has taken so far: a UDP address, or what else the socket is."""
        return [name for name in self._sockets if name not in self._taken]


@cache
def inherited() -> Inherited:
    """Those of this process. Its children get none."""
    return Inherited(socket.socket(fileno=descriptor) for descriptor in _descriptors(os.environ))


def _descriptors(environment: MutableMapping[str, str]) -> list[int]:
    """Takes out what tells of them, which is for one process only."""
    pid, count = environment.pop("LISTEN_PID", ""), environment.pop("LISTEN_FDS", "")
    environment.pop("LISTEN_FDNAMES", None)
    if pid != str(os.getpid()) or not count.isdecimal():
        return []
    descriptors = list(range(FIRST, FIRST + int(count)))
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)
    return descriptors


def _bound_to(held: socket.socket) -> str:
    if (held.family, held.type) == (socket.AF_INET, socket.SOCK_DGRAM):
        interface = bound_interface(held)
        return bound_to(Address(*held.getsockname()), "an interface that has gone" if interface is None else interface)
    return f"{held.getsockname()}, which is no IPv4 UDP socket"

"""Senders of the carrier: native code sends through sockets of `net.sockets`."""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Collection

from router.hosts import is_address, is_any, is_ipv6
from router.net.addresses import know
from router.net.sockets import ListeningSocket, address_beside, is_beside, leaves_from, settle


class NativeSender:
    """Sends to one address, through a socket that `net.sockets.open_sending` has opened for `source`. Owns the socket.

    `address` is that of its `struct sender`. `leaves_from` is its source address, 0.0.0.0 or :: if the kernel chooses
    one for each datagram; `is_bound`: it sends from the port of its listener. `cast` is as in
    `compiler.network`: until the network interface of a group is there, sending fails with EBADF. To a host name, and
    until an address is learned, it fails with EDESTADDRREQ.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        destination: tuple[str, int],
        opened: socket.socket,
        source: ListeningSocket | None = None,
        cast: tuple[str | None, int, bool] | str | None = None,
    ) -> None:
        """Raises MemoryError."""
        self._library = library
        self._cast = cast
        self._place(source, opened)
        host, port = destination
        number = know(library, host) if is_address(host) else 0
        self.address = int(library.sender_open(self._aimed(), self._listening, number, port) or 0)
        if not self.address:
            opened.close()
            raise MemoryError("a sender of the carrier cannot be opened")

    def move(self, source: ListeningSocket | None, opened: socket.socket) -> socket.socket:
        """Send through `opened` from now on. Return the earlier socket; close it when no thread uses it."""
        left = self.socket
        self._place(source, opened)
        self._library.sender_move(self.address, self._aimed(), self._listening)
        return left

    @property
    def has_interface(self) -> bool:
        """Whether it sends to a group through an interface with a name, which may disappear and return."""
        return isinstance(self._cast, tuple) and self._cast[0] is not None

    def follow_interface(self) -> None:
        """Send to a group through the interface that has the name now, and from the listener's address if that is
        there now.
        """
        if self.has_interface:
            self._library.sender_move(self.address, self._aimed(), self._listening)
        if self.source is not None and self.is_bound and is_any(self.leaves_from):
            settle(self.socket, self.source)
            self._place(self.source, self.socket)

    def _aimed(self) -> int:
        """Prepare the socket for its cast, and return its descriptor, or -1 while sending must fail."""
        if isinstance(self._cast, tuple):
            from router.net.multicast import aim  # few tables need it

            return self.socket.fileno() if aim(self.socket, *self._cast) else -1
        if self._cast is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return self.socket.fileno()

    def _place(self, source: ListeningSocket | None, opened: socket.socket) -> None:
        self.socket, self.source = opened, source
        self.is_bound, self.leaves_from = is_beside(opened), leaves_from(opened)
        self._listening = source.socket.fileno() if source is not None and self.is_bound else -1

    def is_placed(self, source: ListeningSocket | None, listening: Collection[ListeningSocket]) -> bool:
        """Return whether a newly opened socket would have the same source address and port."""
        if self.source is not source or source is None or not self.is_bound:
            return self.source is source
        return is_ipv6(self.leaves_from) or self.leaves_from == address_beside(source, listening)[0]

    def close(self) -> None:
        """Close the socket. Sending afterwards raises OSError."""
        self._library.sender_end(self.address)
        self.socket.close()

    def __del__(self) -> None:
        if self.address:
            self._library.sender_close(self.address)

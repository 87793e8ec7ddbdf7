"""Senders of the carrier: the sockets are those of `net.udp`, the sending is native."""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Collection

from router.net.udp import Listener, Sender
from router.table.model import Endpoint


class NativeSender(Sender):
    """See `Sender`. `address` is that of its `struct sender`."""

    def __init__(
        self,
        library: ctypes.CDLL,
        endpoint: Endpoint,
        source: Listener | None = None,
        listeners: Collection[Listener] = (),
    ) -> None:
        """Raises OSError, and MemoryError."""
        self.address = 0
        self._library = library
        super().__init__(endpoint, source, listeners)
        host, port = endpoint.address.value
        number = int.from_bytes(socket.inet_aton(host), "big")
        self.address = int(library.sender_open(self.socket.fileno(), self._listening, number, port) or 0)
        if not self.address:
            super().close()
            raise MemoryError("a sender of the carrier cannot be opened")

    def move(self, source: Listener | None, opened: socket.socket) -> socket.socket:
        left = super().move(source, opened)
        self._library.sender_move(self.address, opened.fileno(), self._listening)
        return left

    @property
    def _listening(self) -> int:
        """The descriptor of the listener from whose port it sends; -1 for none."""
        return self.source.socket.fileno() if self.source is not None and self.is_bound else -1

    def close(self) -> None:
        """Close the socket. Sending afterwards raises OSError."""
        self._library.sender_end(self.address)
        super().close()

    def __del__(self) -> None:
        if self.address:
            self._library.sender_close(self.address)

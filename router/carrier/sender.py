"""Senders of the carrier: the sockets are those of `net.udp`, the sending is native."""

from __future__ import annotations

import ctypes
import os
import socket

from router.net.udp import Sender
from router.table.model import Endpoint


class NativeSender(Sender):
    """A socket that is connected to one destination. `address` is that of its `struct sender`."""

    def __init__(self, library: ctypes.CDLL, endpoint: Endpoint) -> None:
        """Raises StartError, and MemoryError."""
        self.address = 0
        super().__init__(endpoint)
        self._library = library
        host, port = endpoint.address.value
        number = int.from_bytes(socket.inet_aton(host), "big")
        self.address = int(library.sender_open(self.socket.fileno(), number, port) or 0)
        if not self.address:
            self.socket.close()
            raise MemoryError("a sender of the carrier cannot be opened")
        self.send = self._send

    def _send(self, data: bytes) -> int:
        """Send a datagram and return its size, or raise OSError: then exactly one is lost."""
        if error := self._library.sender_send(self.address, data, len(data)):
            raise OSError(error, os.strerror(error))
        return len(data)

    def close(self) -> None:
        """Close the socket. Sending afterwards raises OSError."""
        self._library.sender_end(self.address)
        super().close()

    def __del__(self) -> None:
        if self.address:
            self._library.sender_close(self.address)

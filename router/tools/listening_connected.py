"""Gateways that one connects to. When one goes away, it is connected to again, for ever."""

from __future__ import annotations

import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from router.table.addresses import Address
from router.tools.listening import Arrival

_TRY_AGAIN = 0.5
"""Seconds between two attempts to connect."""

CONNECT_TIMEOUT = 2.0


class ConnectedSource(ABC):
    """Every connection is another sender: a gateway begins anew with its schemas."""

    lost = 0
    """TCP loses nothing; what is unfinished when a connection breaks is told."""

    def __init__(self, protocol: str, address: Address, say: Callable[[str], None]) -> None:
        self.place = f"{protocol} {address}"
        self._address = address
        self._say = say
        self._connected = ExitStack()
        self._number = 0  # of the connection
        self._is_connected = False
        self._is_told = False
        self._next_attempt = 0.0

    def ask(self) -> None:  # noqa: B027 - there is nothing to ask
        """A new client gets all schemas unasked."""

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        if not self._is_connected and not self._connect(timeout):
            return ()
        return [Arrival(data, self._number) for data in self._receive(timeout)]

    def close(self) -> None:
        self._connected.close()

    @abstractmethod
    def _open(self, opened: socket.socket, connected: ExitStack) -> None:
        """Begin to receive; `connected` closes what is entered into it. Raises OSError."""

    @abstractmethod
    def _receive(self, timeout: float) -> Sequence[bytes]:
        """What has come in; calls `_lose` when the connection has ended."""

    def _connect(self, timeout: float) -> bool:
        if (rest := self._next_attempt - time.monotonic()) > 0:
            time.sleep(min(rest, timeout))
            return False
        try:
            opened = socket.create_connection(self._address, CONNECT_TIMEOUT)
            self._connected.enter_context(opened)
            self._open(opened, self._connected)
        except OSError as error:
            self._lose(f"cannot be reached ({error.strerror or error})")
            return False
        if self._number or self._is_told:
            self._say(f"{self.place} is connected")
        self._is_connected, self._is_told = True, False
        self._number += 1
        return True

    def _lose(self, why: str) -> None:
        """Says so once, until there is a connection again."""
        self._connected.close()
        if not self._is_told:
            self._say(f"{self.place} {why}; trying again")
        self._is_connected, self._is_told = False, True
        self._next_attempt = time.monotonic() + _TRY_AGAIN

"""The ends of TCP connections, for tools: of a server, or of a client that connects again and again."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Collection
from contextlib import suppress
from typing import TYPE_CHECKING

from router.errors import UsageError
from router.net.addresses import host_and_port, open_socket, socket_address
from router.net.links import why_closed
from router.net.ready import readable
from router.tools.link_end import OPENED_WITHIN, READ_AT_ONCE, READ_WITHIN, LinkEnd

if TYPE_CHECKING:
    from router.carrier.frames import Frame
    from router.table.addresses import Address
    from router.table.model.endpoints import Listener

AGAIN_AFTER = 0.2
"""Seconds between two attempts to connect."""

ANYBODY = ""


class Server:
    """Accepts one connection from each of `hosts`, by default one from anybody. A newer one replaces it.

    Raises UsageError if the address cannot be bound, with the OSError as its cause.
    """

    def __init__(self, name: str, address: Address, hosts: Collection[str] = (ANYBODY,)) -> None:
        self.address = address
        self._hosts = hosts
        self._accepted: dict[str, socket.socket] = {}
        self._socket = _bound(name, address)
        try:
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            raise _not_bound(name, address, error) from error

    def taken(self, host: str) -> socket.socket | None:
        """Return the newest connection from one of `hosts` if it is another one than before."""
        with suppress(BlockingIOError):
            while True:
                opened, address = self._socket.accept()
                peer, _ = host_and_port(address)
                key = ANYBODY if ANYBODY in self._hosts else peer
                if key not in self._hosts:
                    opened.close()
                    continue
                if (older := self._accepted.pop(key, None)) is not None:
                    older.close()
                self._accepted[key] = opened
        return self._accepted.pop(host, None)

    def close(self) -> None:
        """Close it; more than once is no mistake."""
        self._socket.close()
        for opened in self._accepted.values():
            opened.close()
        self._accepted.clear()


class TcpEnd(LinkEnd):
    """One end of a TCP connection."""

    opens_again = True
    end_of_stream = errno.ECONNRESET

    def __init__(self, link: Listener, address: Address) -> None:
        super().__init__(link, -1, str(address))

    def __str__(self) -> str:
        return f"tcp {self.place}"

    @property
    def is_open(self) -> bool:
        """Whether it is connected. If there is a new connection, it is that from now on."""
        if (opened := self._connection()) is not None:
            self._drop()
            opened.setblocking(False)
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._fd = opened.detach()
        return self._fd >= 0

    def _connection(self) -> socket.socket | None:
        """Return a new connection, if there is one."""
        raise NotImplementedError

    def send(self, payload: bytes) -> None:
        """Likewise, but also raises OSError while it is not connected."""
        if self._fd < 0:
            raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))
        super().send(payload)

    def receive(self) -> list[Frame]:
        try:
            return super().receive()
        except OSError:
            self._drop()
            raise

    def _drop(self) -> None:
        self._begin()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def close(self) -> None:
        """Close the connection after the other end has had time to read it: bytes unread here would reset it."""
        if self._fd >= 0:
            with socket.socket(fileno=self._fd) as opened, suppress(OSError):
                opened.shutdown(socket.SHUT_WR)
                until = time.monotonic() + READ_WITHIN
                while readable([opened], until - time.monotonic()):
                    if not opened.recv(READ_AT_ONCE):
                        break
            self._fd = -1


class Accepting(TcpEnd):
    """The end of a server. `who` is at the other end, for people; `host` is its address."""

    def __init__(self, link: Listener, server: Server, who: str, host: str = ANYBODY) -> None:
        super().__init__(link, server.address)
        self._server = server
        self._who = who
        self._host = host

    @property
    def awaited(self) -> str:
        return f"{self._who} to connect to {self.place}"

    @property
    def where(self) -> str:
        return f"at {self.place}"

    def _connection(self) -> socket.socket | None:
        return self._server.taken(self._host)

    def close(self) -> None:
        self._server.close()
        super().close()


class Connecting(TcpEnd):
    """The end of a client, which connects from the address `host` if one is given.

    `is_patient`: whether `await_open` continues after failures. Raises UsageError if this computer lacks the address.
    """

    def __init__(self, link: Listener, to: Address, host: str | None = None, *, is_patient: bool = False) -> None:
        super().__init__(link, to)
        self._to = to
        self._own = None if host is None else to._replace(host=host, port=0)
        self._is_patient = is_patient
        self._trying: socket.socket | None = None
        self._again = 0.0
        self._failed = 0
        self._socket().close()

    @property
    def awaited(self) -> str:
        return f"the router to listen at {self.place}" if self._is_patient else ""

    @property
    def where(self) -> str:
        return f"to {self.place}"

    def await_open(self) -> None:
        """Likewise. Raises TransportError after a failure, unless it is patient."""
        while not self.is_open:
            if self._failed and not self._is_patient:
                raise self.ended(OSError(self._failed, os.strerror(self._failed)))
            time.sleep(OPENED_WITHIN)

    def _socket(self) -> socket.socket:
        if self._own is not None:
            return _bound(self.name, self._own)
        opened = open_socket(self._to.host, socket.SOCK_STREAM)
        opened.setblocking(False)
        return opened

    def _connection(self) -> socket.socket | None:
        if self._fd >= 0:
            return None
        if self._trying is None:
            if time.monotonic() < self._again:
                return None
            self._again = time.monotonic() + AGAIN_AFTER
            self._trying = self._socket()
        error = self._trying.connect_ex(socket_address(*self._to))
        if error in (errno.EINPROGRESS, errno.EALREADY):
            return None
        opened, self._trying = self._trying, None
        if error in (0, errno.EISCONN):
            return opened
        opened.close()
        self._failed = error
        return None

    def close(self) -> None:
        if self._trying is not None:
            self._trying.close()
        super().close()


def _bound(name: str, address: Address) -> socket.socket:
    opened = open_socket(address.host, socket.SOCK_STREAM)
    try:
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind(socket_address(*address))
    except OSError as error:
        opened.close()
        raise _not_bound(name, address, error) from error
    return opened


def _not_bound(name: str, address: Address, error: OSError) -> UsageError:
    why, remedy = why_closed(error.errno or 0)
    return UsageError(f"'{name}': cannot bind {address}: {why}", remedy)

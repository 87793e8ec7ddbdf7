"""UDP sockets: listeners, inherited ones among them, and senders that account for every datagram."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Iterable, MutableMapping
from contextlib import suppress
from functools import cache

from router.errors import StartError
from router.log import logger
from router.net.kernel import (
    SO_TIMESTAMPNS,
    arrivals,
    ask_for_receive_buffer,
    bound_interface,
    drops,
    port_taken,
    receive_buffer,
)
from router.table import model
from router.table.addresses import Address
from router.table.model import bound_to

_NETWORK_CHANGED = (errno.EDESTADDRREQ, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.EINVAL)
"""Errors of sending if there was no network when the socket was connected, there is none now, or this computer has
lost the address that the socket sends from."""

FIRST_INHERITED = 3
"""The first descriptor that a service manager hands over; the others follow it."""


class Inherited:
    """UDP sockets that a service manager has bound and handed over, as in sd_listen_fds(3), by what they are bound to.

    They outlive the process, with the datagrams in them. Keys are those of `bound_to`: an address, or an address on an
    interface.
    """

    def __init__(self, sockets: Iterable[socket.socket] = ()) -> None:
        self._sockets = {_bound_to(each): each for each in sockets}
        self._taken: set[str] = set()

    def take(self, bound: str) -> socket.socket | None:
        """Return a duplicate of the socket that is bound so, or None. It can be taken again.

        If the socket unit says Timestamping=ns, what waits in it keeps the time at which the kernel got it.
        """
        held = self._sockets.get(bound)
        if held is None or _bound_to(held) != bound:  # the interface may have gone since
            return None
        self._taken.add(bound)
        # Without the option, stamps are read by `arrivals`, and no longer come with each datagram.
        held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)
        held.setblocking(True)
        return held.dup()

    def unclaimed(self) -> list[str]:
        """What no listener has taken: a UDP address, or a description of the socket."""
        return [name for name in self._sockets if name not in self._taken]


@cache
def inherited() -> Inherited:
    """The sockets that this process has inherited. Its children inherit none."""
    return Inherited(socket.socket(fileno=descriptor) for descriptor in _inherited_descriptors(os.environ))


def _inherited_descriptors(environment: MutableMapping[str, str]) -> list[int]:
    """Remove the variables, which are meant for this process only."""
    pid, count = environment.pop("LISTEN_PID", ""), environment.pop("LISTEN_FDS", "")
    environment.pop("LISTEN_FDNAMES", None)
    if pid != str(os.getpid()) or not count.isdecimal():
        return []
    descriptors = list(range(FIRST_INHERITED, FIRST_INHERITED + int(count)))
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)
    return descriptors


def _bound_to(held: socket.socket) -> str:
    if (held.family, held.type) == (socket.AF_INET, socket.SOCK_DGRAM):
        interface = bound_interface(held)
        return bound_to(Address(*held.getsockname()), "an interface that has gone" if interface is None else interface)
    return f"{held.getsockname()}, which is no IPv4 UDP socket"


class Listener:
    """A bound socket: the inherited one with this address and interface if there is one, else a new one.

    Raises StartError with the position in the table and a remedy. Datagrams that are not received from an inherited
    socket wait for the next process, and its kernel drops may be older than this process. `is_stamped`: each datagram
    comes with the time at which the kernel got it; else `arrived_at` returns that of the last one.
    """

    def __init__(self, settings: model.Listener, *, is_stamped: bool = False) -> None:
        self._settings = settings
        handed_over = inherited().take(settings.bound_to)
        self.is_inherited = handed_over is not None
        self.socket = handed_over or socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if is_stamped:
                self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            if handed_over is None:
                if settings.interface is not None:
                    self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, settings.interface.encode())
                # Never SO_REUSEADDR or SO_REUSEPORT: with either, a second router would steal the port unnoticed.
                self.socket.bind(settings.address.value)
            self._request_receive_buffer(settings)
            self.arrived_at = arrivals(self.socket)
        except OSError as error:
            self.socket.close()
            raise _refused(settings, error) from error
        self.address = Address(*self.socket.getsockname())
        self._drops_at_close = 0

    @property
    def name(self) -> str:
        return self._settings.name

    @property
    def bound_to(self) -> str:
        return bound_to(self.address, self._settings.interface)

    @property
    def coalesce(self) -> int:
        """The longest pause between two reads, in ns."""
        return self._settings.coalesce

    @property
    def interface(self) -> str | None:
        return self._settings.interface

    def has_lost_interface(self) -> bool:
        """Whether its network interface has gone. It receives nothing then, nor from a later one of the same name."""
        return self._settings.interface is not None and bound_interface(self.socket) is None

    def follow(self, settings: model.Listener) -> None:
        """Adopt name and settings of another table's listener with the same address and interface."""
        if settings.receive_buffer != self._settings.receive_buffer:
            self._request_receive_buffer(settings)
        self._settings = settings

    def kernel_drops(self) -> int:
        """Datagrams that the kernel dropped before they were received, since the socket was opened."""
        return self._drops_at_close if self.socket.fileno() < 0 else drops(self.socket)

    def end_input(self) -> None:
        """Accept nothing new. What has arrived can still be received, followed by an end with the peer None.

        An inherited socket is left as it is, for the next process: its receiver has to stop by itself.

        A socket that is connected to itself accepts nothing from others, so that a flood cannot keep the receiver busy
        for ever; shutting it down wakes a receiver that waits.
        """
        if self.is_inherited:
            return
        host, port = self.address
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)  # required for a broadcast address
        # If the interface has lost the address, connecting fails, but nothing comes in and shutting down still wakes.
        with suppress(OSError):
            self.socket.connect(("127.0.0.1" if host == "0.0.0.0" else host, port))
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RD)

    def close(self) -> None:
        self._drops_at_close = self.kernel_drops()
        self.socket.close()

    def _request_receive_buffer(self, settings: model.Listener) -> None:
        """An inherited socket may have a larger buffer, for what arrives while no process listens."""
        if self.is_inherited and receive_buffer(self.socket) >= settings.receive_buffer:
            return
        if (granted := ask_for_receive_buffer(self.socket, settings.receive_buffer)) >= settings.receive_buffer:
            return
        logger.warning(
            "receive buffer is smaller than the table asks for: bursts may be dropped by the kernel",
            listener=settings.name,
            asked=settings.receive_buffer,
            granted=granted,
            remedy=f"sysctl -w net.core.rmem_max={settings.receive_buffer}",
        )


def _refused(settings: model.Listener, error: OSError) -> StartError:
    known = {
        errno.ENODEV: ("there is no such network interface now", "`ip link` lists those that there are"),
        errno.EPERM: ("before Linux 5.7 an 'interface' needs a privilege", "grant CAP_NET_RAW"),
        errno.EADDRNOTAVAIL: (
            "no network interface of this computer has that address",
            "0.0.0.0 listens on all of them",
        ),
        errno.EACCES: ("ports below 1024 need a privilege", "choose a higher port, or grant CAP_NET_BIND_SERVICE"),
    }
    if error.errno == errno.EADDRINUSE:
        why, hint = port_taken("udp", settings.address.value.port)
    else:
        why, hint = known.get(error.errno or 0, (error.strerror or str(error), ""))
    what = f"listener '{settings.name}' cannot use {settings.bound_to}"
    return StartError(f"{settings.address.span}: {what}: {why}", hint)


def nobody_listens(address: Address) -> str:
    """What "Connection refused" means for UDP: the computer is there, and no process has the port."""
    return f"nobody listens at {address}"


class Sender:
    """A non-blocking socket, connected to one destination. Opening raises StartError.

    A destination that is unreachable because the link is not up yet is logged, and tried again with every datagram.
    """

    def __init__(self, endpoint: model.Endpoint) -> None:
        self.endpoint, address = endpoint.name, endpoint.address.value
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        try:
            self.socket.connect(address)
        except OSError as error:
            if error.errno != errno.ENETUNREACH:
                self.socket.close()
                what = f"cannot send to endpoint '{self.endpoint}' at {address}"
                raise StartError(f"{endpoint.address.span}: {what}: {error.strerror}") from error
            logger.warning("no network leads to this endpoint yet", endpoint=self.endpoint, address=str(address))
        self.send = _sending(self.socket, address)

    def send_checked(self, data: bytes) -> int:
        """As `send`, but raise errors of this datagram that are known at once: no process listens on a local port.

        With `send`, the next datagram would raise that error, and it may be another user's of this socket.
        """
        sent = self.send(data)
        if error := self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(error, os.strerror(error))
        return sent

    def close(self) -> None:
        self.socket.close()


def _sending(connected: socket.socket, address: Address) -> Callable[[bytes], int]:
    """Return a function that sends a datagram and returns its size, or raises OSError: then exactly one is lost.

    "Connection refused" is about an earlier datagram, which was counted as sent. The kernel returns it instead of
    sending this one; so this one is sent again, and the error raised for the earlier one: the counters balance.

    If the network has changed, `connected` is connected again first.
    """
    send = connected.send

    def send_one(data: bytes) -> int:
        try:
            return send(data)
        except ConnectionRefusedError:
            send(data)
            raise
        except OSError as error:
            if error.errno not in _NETWORK_CHANGED:
                raise
            _reconnect(connected, address)
            return send(data)

    return send_one


def _reconnect(connected: socket.socket, address: Address) -> None:
    """Replace the socket by a new one. `connect` alone would keep its local address, which may have gone."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fresh:
        fresh.setblocking(False)
        fresh.connect(address)
        os.dup2(fresh.fileno(), connected.fileno(), inheritable=False)

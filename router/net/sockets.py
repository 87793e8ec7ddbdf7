"""UDP sockets, opened with plain values: listeners, also inherited ones, and sockets to send from.

An IPv6 socket takes no IPv4: listeners at `::` and at `0.0.0.0` can have the same port.

A head start opens them before anything else is loaded, so settings, findings and messages are in `net.udp`.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Collection, Iterable, Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache

from router.hosts import ANY_HOST, ANY_IPV6, is_address, is_any, is_ipv6, loopback_of, zone
from router.net.addresses import bound_address, open_socket, socket_address
from router.net.kernel import (
    IP_FREEBIND,
    IP_MULTICAST_ALL,
    allow_fragments,
    ask_for_receive_buffer,
    bound_interface,
    discard_unstamped,
    receive_buffer,
    refuse_input,
    report_sending_errors,
    send_arrivals,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Protocol, TypeVar

    from router.net.multicast import Groups

    class Bound(Protocol):
        """A ListeningSocket, or a listener that has one."""

        @property
        def address(self) -> tuple[str, int]: ...

        @property
        def is_waiting(self) -> bool: ...

    Source = TypeVar("Source", bound=Bound)

BOARD_ROOM = 8192
"""Requested send buffer of a board, in bytes: the kernel queues commands until it knows the hardware address.
It grants twice as much, which holds about 20 small datagrams, so that a burst of 16 is queued without loss."""

_MAPPED = "::ffff:"
_NOBODY = "ff00::"
"""A multicast address that is never assigned (RFC 4291, 2.7.1)."""

FIRST_INHERITED = 3
"""The first descriptor that a service manager passes; the others follow it."""


class Inherited:
    """UDP sockets that a service manager has bound and passed, as in sd_listen_fds(3).

    They outlive the process, with the datagrams queued in them.
    """

    def __init__(self, sockets: Iterable[socket.socket] = ()) -> None:
        self._sockets = list(sockets)
        self._taken: list[socket.socket] = []

    def take(self, address: tuple[str, int], interface: str | None) -> socket.socket | None:
        """Return a duplicate of the socket with this address and interface, or None. It can be taken again."""
        for held in self._sockets:
            if _is_bound_to(held, address, interface):
                self._taken.append(held)
                held.setblocking(True)
                return held.dup()
        return None

    def unclaimed(self) -> list[socket.socket]:
        """Return the sockets that no listener has taken."""
        return [held for held in self._sockets if held not in self._taken]


def _is_bound_to(held: socket.socket, address: tuple[str, int], interface: str | None) -> bool:
    return is_udp(held) and bound_address(held) == address and bound_interface(held) == (interface or zone(address[0]))


def is_udp(held: socket.socket) -> bool:
    return held.family in (socket.AF_INET, socket.AF_INET6) and held.type == socket.SOCK_DGRAM


@cache
def inherited() -> Inherited:
    """Return the sockets that this process has inherited. Child processes do not inherit them."""
    return Inherited(socket.socket(fileno=descriptor) for descriptor in _inherited_descriptors(os.environ))


def _inherited_descriptors(environment: MutableMapping[str, str]) -> list[int]:
    """Parse and remove the variables, which are meant for this process only."""
    pid, count = environment.pop("LISTEN_PID", ""), environment.pop("LISTEN_FDS", "")
    environment.pop("LISTEN_FDNAMES", None)
    if pid != str(os.getpid()) or not count.isdecimal():
        return []
    descriptors = list(range(FIRST_INHERITED, FIRST_INHERITED + int(count)))
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)
    return descriptors


ABSENT = {
    errno.ENODEV: ("there is no such network interface", "run `ip link` to list the interfaces"),
    errno.EADDRNOTAVAIL: (
        "no network interface of this computer has that address",
        "use 0.0.0.0 (for IPv6, [::]) to listen on all of them",
    ),
    errno.ENETDOWN: ("the network is down", "run `ip link` to see which interface is"),
}
"""Errors of binding that disappear when the network comes up, each with its message and a remedy."""


def bind(opened: socket.socket, address: tuple[str, int], interface: str | None) -> None:
    """Bind a socket to an address, and to a network interface unless None. Raises OSError."""
    if interface is not None:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
    opened.bind(socket_address(*address))


def open_udp(host: str) -> socket.socket:
    """Return a new UDP socket of the family of a host. An IPv6 one takes no IPv4."""
    return open_socket(host, socket.SOCK_DGRAM)


class ListeningSocket:
    """A bound socket: the inherited one with this address and interface if there is one, else a new one.

    While its address or interface is missing, for example that of a tunnel that comes up later, it `is_waiting`: the
    socket is not bound and receives nothing, and `address` is the wanted one. Any other failure raises OSError.
    `has_senders`: senders bound to its port are open. `receive_buffer` is the granted size in bytes. `wanted` are the
    address and the interface that it was opened for. With `groups`, it shares the port with other programs;
    `missing_groups` are those that are not joined now, each with the reason.
    """

    def __init__(
        self,
        address: tuple[str, int],
        interface: str | None,
        receive_buffer: int,
        groups: Collection[str] = (),
        *,
        has_senders: bool = False,
    ) -> None:
        handed_over = inherited().take(address, interface)
        self.is_inherited = handed_over is not None
        self.socket = handed_over or open_udp(address[0])
        self.interface = interface
        self.address = address
        self.wanted = address, interface
        self.is_waiting = False
        self._groups: Groups | None = None
        self._is_shared = False
        try:
            if handed_over is not None:
                discard_unstamped(handed_over)
            send_arrivals(self.socket)
            # Never SO_REUSEPORT, and SO_REUSEADDR only beside senders and for a moment, or with groups: with either, a
            # second router would steal the port unnoticed.
            with self.shared() if has_senders or groups else nullcontext():
                if handed_over is None:
                    self._try_to_bind()
            self.follow_groups(groups)
            report_sending_errors(self.socket)
            self.request_receive_buffer(receive_buffer)
        except OSError:
            self.socket.close()
            raise

    def _try_to_bind(self) -> None:
        try:
            bind(self.socket, self.address, self.interface)
        except OSError as error:
            if error.errno not in ABSENT:
                raise
            self.is_waiting = True
        else:
            self.address = self.address[0], self.socket.getsockname()[1]

    def request_receive_buffer(self, size: int) -> None:
        """Request a buffer. An inherited socket keeps a larger one, for datagrams that arrive between processes."""
        self.receive_buffer = receive_buffer(self.socket)
        if not self.is_inherited or self.receive_buffer < size:
            self.receive_buffer = ask_for_receive_buffer(self.socket, size)

    def follow_groups(self, wanted: Collection[str]) -> None:
        """Join the `wanted` groups, also again on an interface that has come back, and leave the others.

        Raises OSError. Use it in one thread at a time.
        """
        if self._groups is None:
            if not wanted:
                return
            from router.net.multicast import Groups  # few tables need it

            self._groups = Groups(self.socket, self.interface)
        self._is_shared = bool(wanted)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, self._is_shared)
        if not self.is_waiting:
            self._groups.follow(wanted)

    @property
    def missing_groups(self) -> Mapping[str, str]:
        return self._groups.missing if self._groups is not None else {}

    def close(self) -> None:
        self.socket.close()

    def has_lost_interface(self) -> bool:
        """Return whether its interface is gone. It then receives nothing, even if one of that name reappears.

        Thread-safe; false for a closed socket.
        """
        is_lost = (self.interface is not None or zone(self.address[0])) and bound_interface(self.socket) is None
        return bool(is_lost) and self.socket.fileno() >= 0

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Allow sockets with SO_REUSEADDR to bind its address and port within the context."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            yield
        finally:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, self._is_shared)

    def end_input(self) -> None:
        """Accept nothing new. Queued datagrams can still be received; after them, receiving returns the peer None.

        An inherited socket stays unchanged for the next process: its receiver must stop without this signal.

        A socket that is connected to itself accepts nothing from others, so a flood cannot keep the receiver busy
        forever; shutting it down wakes a waiting receiver.
        """
        if self.is_inherited:
            return
        host, port = self.address
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)  # required for a broadcast address
        # If the interface has lost the address, connecting fails, but nothing arrives and shutting down still wakes.
        if not self.is_waiting:
            with suppress(OSError):
                self.socket.connect(socket_address(loopback_of(host) if is_any(host) else host, port))
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RD)


def placed(source: Source | None, every: Iterable[Source]) -> Source | None:
    """Return the listener to send from; while it is waiting, another one with the same address and port."""
    if source is None or not source.is_waiting:
        return source
    return next(
        (listener for listener in every if listener.address == source.address and not listener.is_waiting), source
    )


def open_sending(
    source: ListeningSocket | None,
    listening: Collection[ListeningSocket] = (),
    *,
    is_board: bool = False,
    host: str = ANY_HOST,
) -> socket.socket:
    """Open a non-blocking, unconnected socket for one destination, which is `host`. It receives nothing.

    It is bound to address and port of `source`, so that replies reach that listener; without one, or while it is
    waiting, the kernel chooses the port. `listening` are all open listeners, which must allow it. Raises OSError.
    """
    opened = _open_free(host) if source is None or source.is_waiting else _open_beside(source, listening)
    if is_board:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BOARD_ROOM)
    return opened


def is_beside(opened: socket.socket) -> bool:
    """Return whether a socket sends from the port of a listener."""
    return str(opened.getsockname()[0]).startswith((_MAPPED, _NOBODY))


def leaves_from(opened: socket.socket) -> str:
    """Return the source address of a sending socket, without an interface; 0.0.0.0 or :: if the kernel chooses one for
    each datagram.
    """
    host = str(opened.getsockname()[0])
    if host != _NOBODY:
        return host.removeprefix(_MAPPED)
    try:
        return str(opened.getpeername()[0])
    except OSError:  # it is not connected
        return ANY_IPV6


def address_beside(source: ListeningSocket, listening: Iterable[ListeningSocket]) -> tuple[str, int]:
    """Return the address that a socket has which sends from a listener's port.

    If another listener has all addresses of another interface, an IPv4 socket with a specific address would receive its
    datagrams: Linux prefers such sockets.
    """
    everywhere = ANY_HOST, source.address[1]
    if is_ipv6(source.address[0]):
        return source.address
    return everywhere if any(listener.address == everywhere for listener in listening) else source.address


def _open_free(host: str) -> socket.socket:
    """Open a socket for a host, also for a name, that reports ICMP errors and receives nothing."""
    opened = open_udp(host) if is_address(host) else _open_for_either()
    opened.setblocking(False)
    allow_fragments(opened)
    report_sending_errors(opened)
    refuse_input(opened)
    return opened


def _open_for_either() -> socket.socket:
    """Open a socket that sends to IPv4 and IPv6 hosts; to IPv4 ones only, where the kernel has no IPv6."""
    try:
        opened = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
    except OSError as error:
        if error.errno != errno.EAFNOSUPPORT:
            raise
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
    return opened


def _open_beside(source: ListeningSocket, listening: Collection[ListeningSocket]) -> socket.socket:
    """Open a socket that sends from a listener's address and port, while only the listener receives.

    For IPv4, it is an IPv6 socket with an IPv4 address: of two sockets that match a datagram or an ICMP error, Linux
    prefers the one with the datagram's address family. For IPv6, it is bound to a multicast address, to which nothing
    is sent: Linux then chooses the source address.
    """
    host, port = address_beside(source, listening)
    opened = _open_free(ANY_IPV6)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if not is_ipv6(host):
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            opened.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)  # otherwise it gets a copy of what groups get
            opened.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)  # as an inherited listener may have been
        with ExitStack() as shared:
            for listener in listening:
                if listener.address[1] == port:
                    shared.enter_context(listener.shared())
            opened.bind((_NOBODY if is_ipv6(host) else f"{_MAPPED}{host}", port))
        settle(opened, source)
    except OSError:
        opened.close()
        raise
    return opened


def settle(opened: socket.socket, source: ListeningSocket) -> None:
    """Have a socket from `open_sending` send from the IPv6 address of its listener, if this computer has that now.

    Connecting selects the source address; the socket can still send to any address.
    """
    host, port = source.address
    if not is_ipv6(host) or is_any(host):
        return
    # An inherited socket may have an address that is not there: connecting would select another one.
    with suppress(OSError), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        probe.bind(socket_address(host, 0))
        opened.connect(socket_address(host, port))

"""UDP sockets: listeners, inherited ones among them, and those to send from."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Collection, Iterable, Iterator, MutableMapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache

from router.errors import StartError
from router.log import logger
from router.net.kernel import (
    IP_FREEBIND,
    ask_for_receive_buffer,
    bound_interface,
    drops,
    receive_buffer,
    refuse_input,
    report_sending_errors,
    send_arrivals,
    why_not_bound,
)
from router.table import model
from router.table.addresses import Address, not_one_machine
from router.table.model import bound_to

BOARD_ROOM = 8192
"""Bytes to ask for as the send buffer of a board, as the kernel keeps commands while it looks for the hardware address.
Twice as much is granted, which holds about 20 small datagrams: a burst of 16 passes though none has left yet."""

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
        """Return a duplicate of the socket that is bound so, or None. It can be taken again."""
        held = self._sockets.get(bound)
        if held is None or _bound_to(held) != bound:  # the interface may have gone since
            return None
        self._taken.add(bound)
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


_ABSENT = {
    errno.ENODEV: ("there is no such network interface", "`ip link` lists those that there are"),
    errno.EADDRNOTAVAIL: ("no network interface of this computer has that address", "0.0.0.0 listens on all of them"),
    errno.ENETDOWN: ("the network is down", "`ip link` shows which interface is"),
}
"""Errors of binding that pass when the network comes up, each with a remedy for one that does not."""


def absence(address: Address, interface: str | None) -> tuple[str, str] | None:
    """Why a listener cannot have that address and interface before the network comes up, with a remedy, or None."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            _bind(probe, address, interface)
        except OSError as error:
            return _ABSENT.get(error.errno or 0)
    return None


def _is_absent(host: str) -> bool:
    return absence(Address(host, 0), None) is not None


def _bind(opened: socket.socket, address: Address, interface: str | None) -> None:
    if interface is not None:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
    opened.bind(address)


class Listener:
    """A bound socket: the inherited one with this address and interface if there is one, else a new one.

    While its address or interface is not there, as that of a tunnel that comes up later, it is waiting: the socket is
    not bound and receives nothing, and another Listener has to replace it. Any other failure raises StartError with the
    position in the table and a remedy. Datagrams that are not received from an inherited
    socket wait for the next process, and its kernel drops may be older than this process. Each datagram comes with the
    time at which the kernel got it, where the kernel has it. `has_senders`: some that are bound to its port are open.
    """

    def __init__(self, settings: model.Listener, *, has_senders: bool = False) -> None:
        self._settings = settings
        handed_over = inherited().take(settings.bound_to)
        self.is_inherited = handed_over is not None
        self.socket = handed_over or socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            send_arrivals(self.socket)
            # Never SO_REUSEPORT, and SO_REUSEADDR only beside senders and for a moment: with either, a second router
            # would steal the port unnoticed.
            with self.shared() if has_senders else nullcontext():
                self.is_waiting = handed_over is None and not self._try_to_bind()
            report_sending_errors(self.socket)
            self._request_receive_buffer(settings)
        except OSError as error:
            self.socket.close()
            raise _refused(settings, error) from error
        self.address = settings.address.value if self.is_waiting else Address(*self.socket.getsockname())
        self._drops_at_close = 0

    @property
    def name(self) -> str:
        return self._settings.name

    @property
    def bound_to(self) -> str:
        return bound_to(self.address, self._settings.interface)

    @property
    def interface(self) -> str | None:
        return self._settings.interface

    def _try_to_bind(self) -> bool:
        """Bind the socket. Return False if its address or interface is not there, and raise other errors."""
        try:
            _bind(self.socket, self._settings.address.value, self._settings.interface)
        except OSError as error:
            if error.errno not in _ABSENT:
                raise
            return False
        return True

    def has_lost_interface(self) -> bool:
        """Whether its network interface has gone. It receives nothing then, nor from a later one of the same name."""
        return self._settings.interface is not None and bound_interface(self.socket) is None

    def lacks_network(self) -> bool:
        """Whether its address or network interface is not there. It receives nothing then."""
        return self.is_waiting or self.has_lost_interface() or _is_absent(self.address.host)

    def is_replaceable(self) -> bool:
        """Whether it will receive nothing any more, and another Listener would."""
        has_ended = self.is_waiting or self.has_lost_interface()
        return has_ended and absence(self._settings.address.value, self._settings.interface) is None

    def follow(self, settings: model.Listener) -> None:
        """Adopt name and settings of another table's listener with the same address and interface."""
        if settings.receive_buffer != self._settings.receive_buffer:
            self._request_receive_buffer(settings)
        self._settings = settings

    def kernel_drops(self) -> int:
        """Datagrams that the kernel dropped before they were received, since the socket was opened."""
        return self._drops_at_close if self.socket.fileno() < 0 else drops(self.socket)

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Let sockets with SO_REUSEADDR bind its address and port meanwhile."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            yield
        finally:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)

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
        if not self.is_waiting:
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
    why, hint = why_not_bound("udp", settings.address.value.port, error)
    if error.errno == errno.EPERM:
        why, hint = "before Linux 5.7 an 'interface' needs a privilege", "grant CAP_NET_RAW"
    what = f"listener '{settings.name}' cannot use {settings.bound_to}"
    return StartError(f"{settings.address.span}: {what}: {why}", hint)


def nobody_listens(address: Address) -> str:
    """What "Connection refused" means for UDP: the computer is there, and no process has the port."""
    return f"nobody listens at {address}"


def why_not_sent(error: OSError, address: Address) -> str:
    """Say in words why nothing was sent to an address, with what shows more."""
    ask = f"`ip route get {address.host}`"
    match error.errno:
        case errno.ECONNREFUSED:
            return nobody_listens(address)
        case errno.EACCES:
            return f"a route or rule of this computer prohibits sending to {address.host}: {ask}"
        case errno.EPERM:
            return f"a firewall of this computer forbids sending to {address}: `nft list ruleset`"
        case errno.ENETUNREACH | errno.EHOSTUNREACH:
            return f"no route leads to {address.host}, or nobody there answers: {ask}"
        case errno.EINVAL:
            return f"the routes of this computer discard what is sent to {address.host}: {ask}"
    return error.strerror or str(error)


def why_unreachable(address: Address) -> tuple[str, str] | None:
    """Why nothing can be sent to an address now, with a remedy; None if a route leads there.

    Raises BadAddressError for a broadcast address, which only the computer's interfaces tell.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)  # sends nothing
        except OSError as error:
            if error.errno == errno.EACCES and _is_broadcast(address):
                raise not_one_machine(address) from error
            if error.errno == errno.ENETUNREACH:
                return "no network leads there", "does `ip address` show an interface in its network? is the cable in?"
            why = error.strerror.lower() if error.strerror else str(error)
            return f"the kernel refuses it: {why}", f"`ip route get {address.host}` shows the route that refuses it"
    return None


def usual_source(address: Address) -> str | None:
    """The address of this computer that the route to an address has; None if no route leads there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        return str(probe.getsockname()[0]) if probe.connect_ex(address) == 0 else None


def _is_broadcast(address: Address) -> bool:
    """Whether the kernel takes the address where broadcast is allowed; it also refuses what a route prohibits."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return probe.connect_ex(address) == 0


class Sender:
    """A non-blocking socket for one destination, which it is not connected to.

    It is bound to address and port of `source`, so that answers reach that listener; without one, or while that one is
    waiting, the kernel chooses the port. `listeners` are all that are open: they must allow it. The socket itself
    receives nothing. Opening raises OSError if descriptors are short.
    """

    def __init__(
        self, endpoint: model.Endpoint, source: Listener | None = None, listeners: Collection[Listener] = ()
    ) -> None:
        self.endpoint = endpoint.name
        self._is_board = endpoint.kind is model.EndpointKind.BOARD
        self.source = source
        self.socket = self.open_socket(source, listeners)

    def open_socket(self, source: Listener | None, listeners: Collection[Listener]) -> socket.socket:
        """Open a socket to move to."""
        opened = self._open(source, listeners)
        if self._is_board:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BOARD_ROOM)
        return opened

    def _open(self, source: Listener | None, listeners: Collection[Listener]) -> socket.socket:
        if source is not None and not source.is_waiting:
            try:
                return _open_beside(source, listeners)
            except OSError as error:
                logger.warning(
                    "datagrams to this endpoint leave from a port that is not its listener's; answers to them are lost",
                    endpoint=self.endpoint,
                    listener=source.name,
                    why=error.strerror,
                )
        return _open_sending(socket.AF_INET)

    def move(self, source: Listener | None, opened: socket.socket) -> socket.socket:
        """Send by `opened` from now on. Return the earlier socket, for the caller to close when no thread uses it."""
        left, self.socket, self.source = self.socket, opened, source
        return left

    def is_placed(self, source: Listener | None, listeners: Collection[Listener]) -> bool:
        """Whether it sends from where one that is opened now would."""
        if self.source is not source or source is None or not self.is_bound:
            return self.source is source
        return self.leaves_from == _address_beside(source, listeners).host

    @property
    def leaves_from(self) -> str:
        """The address that the socket is bound to; 0.0.0.0 if the kernel chooses one for each datagram."""
        return str(self.socket.getsockname()[0]).removeprefix("::ffff:")

    @property
    def is_bound(self) -> bool:
        """Whether it sends from the port of its listener."""
        return self.socket.family == socket.AF_INET6

    def close(self) -> None:
        self.socket.close()


def _open_sending(family: socket.AddressFamily) -> socket.socket:
    """A socket that reports ICMP errors, and receives nothing."""
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setblocking(False)
    report_sending_errors(opened)
    refuse_input(opened)
    return opened


def _address_beside(listener: Listener, listeners: Iterable[Listener]) -> Address:
    """Where a socket that sends from a listener's port is bound.

    One with an address of its own would get what another listener, at all addresses of another interface, is to
    receive: Linux looks for such sockets first.
    """
    everywhere = Address("0.0.0.0", listener.address.port)
    return everywhere if any(each.address == everywhere for each in listeners) else listener.address


def _open_beside(listener: Listener, listeners: Collection[Listener]) -> socket.socket:
    """A socket that sends from a listener's address and port, while the listener alone receives.

    It is an IPv6 socket with an IPv4 address: of two sockets that match a datagram or an ICMP error, Linux prefers the
    one of the datagram's own family.
    """
    opened = _open_sending(socket.AF_INET6)
    try:
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        opened.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)  # as an inherited listener may have been
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        host, port = _address_beside(listener, listeners)
        with ExitStack() as shared:
            for each in listeners:
                if each.address.port == port:
                    shared.enter_context(each.shared())
            opened.bind((f"::ffff:{host}", port))
    except OSError:
        opened.close()
        raise
    return opened

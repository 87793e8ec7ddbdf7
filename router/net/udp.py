"""UDP sockets with the settings of a table, and messages about sockets that do not meet them."""

from __future__ import annotations

import errno
import socket
from collections.abc import Collection, Mapping

from router.errors import StartError
from router.hosts import zone
from router.log import logger
from router.net import sockets
from router.net.addresses import bound_address, interface_index, socket_address
from router.net.kernel import bound_interface, drops, why_not_bound
from router.net.sockets import ABSENT, ListeningSocket
from router.table.addresses import Address, not_one_machine
from router.table.model import endpoints
from router.table.model.endpoints import bound_to


def unclaimed() -> list[str]:
    """Return the inherited sockets that no listener has taken: UDP addresses, and descriptions of other sockets."""
    return [_described(held) for held in sockets.inherited().unclaimed()]


def _described(held: socket.socket) -> str:
    if not sockets.is_udp(held):
        return f"{held.getsockname()}, which is not a UDP socket"
    interface = bound_interface(held)
    address = Address(*bound_address(held))
    if interface == zone(address.host):
        interface = ""
    return bound_to(address, "an interface that has gone" if interface is None else interface)


def absence(address: Address, interface: str | None) -> tuple[str, str] | None:
    """Return why a listener must wait for its address or interface, with a remedy; None if it need not."""
    try:
        with sockets.open_udp(address.host) as probe:
            sockets.bind(probe, address, interface)
    except OSError as error:
        return ABSENT.get(error.errno or 0)
    return None


def _is_absent(host: str) -> bool:
    return absence(Address(host, 0), None) is not None


class Listener:
    """A listener of the table, and its socket: an open one, or a new one.

    While it is waiting (see `ListeningSocket`), another Listener must replace it. Any failure raises StartError with
    the position in the table and a remedy. Datagrams left in an inherited socket wait for the next process, and its
    kernel drops may be older than this process. Each datagram comes with its arrival time, if the kernel provides it.
    """

    def __init__(
        self, settings: endpoints.Listener, *, opened: ListeningSocket | None = None, has_senders: bool = False
    ) -> None:
        self._settings = settings
        try:
            self.opened = opened or ListeningSocket(
                settings.address.value,
                settings.interface,
                settings.receive_buffer,
                settings.group_hosts,
                has_senders=has_senders,
            )
        except OSError as error:
            raise _refused(settings, error) from error
        self.socket = self.opened.socket
        self.address = Address(*self.opened.address)
        self.is_inherited = self.opened.is_inherited
        self.is_waiting = self.opened.is_waiting
        self._check_receive_buffer()
        self._check_family()
        self._log_groups({})
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

    def has_lost_interface(self) -> bool:
        """Return whether its interface is gone. It then receives nothing, even if one of that name reappears."""
        return self.opened.has_lost_interface()

    def lacks_network(self) -> bool:
        """Return whether its address or network interface is missing. Then it receives nothing."""
        return self.is_waiting or self.has_lost_interface() or _is_absent(self.address.host)

    def is_replaceable(self) -> bool:
        """Return whether it can no longer receive, but a new Listener could."""
        has_ended = self.is_waiting or self.has_lost_interface()
        return has_ended and absence(self._settings.address.value, self._settings.interface) is None

    def follow(self, settings: endpoints.Listener) -> None:
        """Adopt name and settings of the next table's listener with the same address and interface."""
        has_changed = settings.receive_buffer != self._settings.receive_buffer
        self._settings = settings
        if has_changed:
            self.opened.request_receive_buffer(settings.receive_buffer)
            self._check_receive_buffer()
        self.join_groups()

    def join_groups(self) -> None:
        """Join the groups of its settings, also again on an interface that has come back. Use one thread at a time."""
        before = {**self.missing_groups}
        self.opened.follow_groups(self._settings.group_hosts)
        self._log_groups(before)

    @property
    def missing_groups(self) -> Mapping[str, str]:
        """The groups that are not joined now, each with the reason. A waiting listener has none."""
        return self.opened.missing_groups

    @property
    def has_groups(self) -> bool:
        return bool(self._settings.groups)

    def _log_groups(self, before: Mapping[str, str]) -> None:
        for group, why in self.missing_groups.items():
            if before.get(group) != why:
                logger.warning(
                    "multicast group not joined: the listener does not receive it; the router tries each second",
                    listener=self.name,
                    group=group,
                    why=why,
                    remedy="bring the network up, add a route to the group, or give the listener an `interface`",
                )
        if joined := [group for group in before if group not in self.missing_groups]:
            logger.info("multicast groups joined", listener=self.name, groups=joined)

    def kernel_drops(self) -> int:
        """Return the number of datagrams that the kernel has dropped since the socket was opened. Thread-safe."""
        try:
            return drops(self.socket)
        except OSError:  # it is closed
            return self._drops_at_close

    def end_input(self) -> None:
        """See `ListeningSocket.end_input`."""
        self.opened.end_input()

    def close(self) -> None:
        self._drops_at_close = self.kernel_drops()
        self.socket.close()

    def _check_receive_buffer(self) -> None:
        requested, granted = self._settings.receive_buffer, self.opened.receive_buffer
        if granted < requested:
            logger.warning(
                "receive buffer is smaller than the table requests: the kernel may drop bursts",
                listener=self.name,
                asked=requested,
                granted=granted,
                remedy=f"sysctl -w net.core.rmem_max={requested}",
            )

    def _check_family(self) -> None:
        if self.address.is_ipv6 and not self.socket.getsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY):
            logger.warning(
                "an inherited IPv6 socket also has the IPv4 port: what it receives there is rejected",
                listener=self.name,
                address=str(self.address),
                remedy="write BindIPv6Only=ipv6-only in its socket unit",
            )


def _refused(settings: endpoints.Listener, error: OSError) -> StartError:
    kind, why, hint = why_not_bound("udp", settings.address.value.port, error)
    if error.errno == errno.EPERM:
        why, hint = "before Linux 5.7 an 'interface' needs a privilege", "grant CAP_NET_RAW"
    what = f"listener '{settings.name}' cannot use {settings.bound_to}"
    return kind(f"{settings.address.span}: {what}: {why}", hint)


def nobody_listens(address: Address) -> str:
    """Return the meaning of "Connection refused" for UDP: the computer answers, but no process has the port."""
    return f"nobody listens at {address}"


def why_not_sent(error: OSError, address: Address) -> str:
    """Describe why nothing was sent to an address, with a command that shows more."""
    if address.is_name or address.is_learned:
        return _why_no_address(address)
    ask = f"`{_ask_routes(address.host)}`"
    match error.errno:
        case errno.ECONNREFUSED:
            return nobody_listens(address)
        case errno.EACCES:
            return f"a route or rule of this computer prohibits sending to {address.host}: {ask}"
        case errno.EPERM:
            return f"a firewall of this computer forbids sending to {address}: `nft list ruleset`"
        case errno.ENETUNREACH | errno.EHOSTUNREACH:
            return f"no route leads to {address.host}, or it does not answer: {ask}"
        case errno.EBADF | errno.ENODEV:
            return f"the network interface through which {address.host} is reached is missing: `ip link`"
        case errno.EADDRNOTAVAIL:
            return f"this computer has no address from which it can send to {address.host}: `ip address`"
        case errno.EINVAL if zone(address.host):
            return f"the network interface {zone(address.host)} is missing: `ip link`"
        case errno.EINVAL:
            return f"the routes of this computer discard datagrams to {address.host}: {ask}"
    return error.strerror or str(error)


def _why_no_address(address: Address) -> str:
    if address.is_learned:
        return "its address is not learned: nobody has sent a message for a route with this source"
    return f"the host name {address.host} is not resolved: `getent ahosts {address.host}`"


def _ask_routes(host: str) -> str:
    """Return the command that shows the route to an IP address."""
    bare, _, interface = host.partition("%")
    return f"ip route get {bare}{f' oif {interface}' if interface else ''}"


def why_unreachable(address: Address) -> tuple[str, str] | None:
    """Return why nothing can be sent to an address now, with a remedy; None if a route leads there.

    Raises BadAddressError for a broadcast address, which depends on the computer's interfaces.
    """
    try:
        with sockets.open_udp(address.host) as probe:
            probe.connect(socket_address(*address))  # sends nothing
    except OSError as error:
        if error.errno == errno.EACCES and not address.is_ipv6 and _is_broadcast(address):
            raise not_one_machine(address) from error
        if error.errno in (errno.ENETUNREACH, errno.EADDRNOTAVAIL):
            return (
                "no route leads there",
                "check the cable, and that `ip address` shows an interface in its network",
            )
        if error.errno == errno.ENODEV:
            return ABSENT[errno.ENODEV]
        why = error.strerror.lower() if error.strerror else str(error)
        return f"the kernel refuses it: {why}", f"run `{_ask_routes(address.host)}` to see which route refuses it"
    return None


def why_no_way(endpoint: endpoints.Endpoint) -> tuple[str, str] | None:
    """Return why nothing can be sent to an endpoint now, with a remedy, as `why_unreachable` for its address."""
    address = endpoint.address.value
    if endpoint.interface is not None:
        return ABSENT[errno.ENODEV] if interface_index(endpoint.interface) is None else None
    return None if endpoint.broadcast is not None and _is_broadcast(address) else why_unreachable(address)


def usual_source(address: Address) -> str | None:
    """Return the source address of the route to an address, without an interface; None if there is no route."""
    try:
        with sockets.open_udp(address.host) as probe:
            probe.connect(socket_address(*address))
            return str(probe.getsockname()[0])
    except OSError:
        return None


def _is_broadcast(address: Address) -> bool:
    """Return whether the kernel accepts the address with SO_BROADCAST, unlike one that a route prohibits."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return probe.connect_ex(address) == 0


def open_sending(
    endpoint: endpoints.Endpoint, source: Listener | None = None, listening: Collection[ListeningSocket] = ()
) -> socket.socket:
    """Open a socket to send to an endpoint, from the port of `source` if possible, as in `sockets.open_sending`.

    `listening` are all open listeners. Raises OSError if descriptors run out.
    """
    is_board, host = endpoint.kind is endpoints.EndpointKind.BOARD, endpoint.address.value.host
    if source is not None:
        try:
            return sockets.open_sending(source.opened, listening, is_board=is_board, host=host)
        except OSError as error:
            logger.warning(
                "datagrams to this endpoint do not leave from its listener's port; replies to them are lost",
                endpoint=endpoint.name,
                listener=source.name,
                why=error.strerror,
            )
    return sockets.open_sending(None, is_board=is_board, host=host)

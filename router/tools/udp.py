"""UDP for the tools: addresses as typed or named in a table, sockets, and a datagram sent once or at a rate."""

from __future__ import annotations

import contextlib
import errno
import itertools
import socket
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.errors import TransportError, UsageError, did_you_mean
from router.hosts import ANY_HOST, any_of, bracketed, is_any, is_ipv6, loopback_of
from router.net.addresses import addresses_of, bound_address, family, open_socket, socket_address
from router.table.addresses import Address, BadAddressError, LinkPlace, is_host, parse_ipv6

if TYPE_CHECKING:
    from router.table.model import RouteTable
    from router.table.model.endpoints import Endpoint, Listener
    from router.types.protobuf import Envelope
    from router.types.table_envelopes import Envelopes

ANYWHERE = Address(ANY_HOST, 0)
"""Any local address and port, chosen by the kernel. `origin_of` makes it one of the destination's family."""


def destination(text: str, table: RouteTable | None) -> Address:
    """Parse `HOST:PORT`, or the name of an endpoint or listener of the table. Raises UsageError."""
    if table is not None and text in table.listeners and text not in table.endpoints:
        return listener_address(table.listeners[text])
    if (named := _named(text, table)) is not None:
        return reachable(named)
    host, port = _split(text)
    if not host or port is None:
        raise _not_a_place(text, table, "HOST:PORT")
    _refuse_port_of_name(host, port, table)
    return Address(_resolve(host), _port(port, lowest=1))


def listening(text: str, table: RouteTable | None) -> Address:
    """Parse `[HOST:]PORT`, or a name of the table. Without a host, all local IPv4 addresses. Raises UsageError."""
    if (named := _named(text, table)) is not None:
        return named
    host, port = ("", text) if text.isdigit() else _split(text)
    if port is None or not port.isdigit():
        raise _not_a_place(text, table, "[HOST:]PORT")
    _refuse_port_of_name(host, port, table)
    return Address(_resolve(host) if host else ANY_HOST, _port(port, lowest=0))


def received_at(address: Address, table: RouteTable, envelopes: Envelopes) -> Envelope:
    """Return the envelope that an endpoint or listener with this address receives, by default the first one."""
    hosts = (address.host, any_of(address.host))
    for endpoint in table.endpoints.values():
        if endpoint.address.value == address or (is_any(address.host) and endpoint.address.value.port == address.port):
            return envelopes.to(endpoint.name)
    for listener in table.listeners.values():
        if listener.address.value.port == address.port and listener.address.value.host in hosts:
            return envelopes.at(listener.name)
    return envelopes.first


def origin(text: str, table: RouteTable | None) -> Address:
    """Parse `HOST[:PORT]`, or an endpoint's name: its host, and its `source_port` if it has one. Raises UsageError."""
    if table is not None and text in table.endpoints:
        endpoint = table.endpoints[text]
        own = ANYWHERE if endpoint.address.value.is_learned else place_of(endpoint, table)
        return own._replace(port=endpoint.source_port.value if endpoint.source_port else 0)
    host, port = _split(text)
    if port is not None:
        _refuse_port_of_name(host, port, table)
        return Address(_resolve(host), _port(port, lowest=0))
    if table is not None and not is_ipv6(host) and not host[:1].isdigit() and host != "localhost":
        raise _not_a_place(text, table, "HOST[:PORT]")
    return Address(_resolve(host), 0)


def origin_of(to: Address, origin: Address = ANYWHERE) -> Address:
    """Return the address to bind for sending to `to` from `origin`. Raises UsageError if only one of them is IPv6."""
    if is_any(origin.host):
        return origin._replace(host=any_of(to.host))
    if origin.is_ipv6 != to.is_ipv6:
        what = f"nothing can be sent to {to} from {origin.host}: only one of them is an IPv6 address"
        raise UsageError(what, f"give --from an {'IPv6' if to.is_ipv6 else 'IPv4'} address")
    return origin


def reachable(address: Address, interface: str | None = None) -> Address:
    """Return the address that reaches a socket bound to `address` and `interface`, from this computer.

    Raises UsageError if the interface has no address of the same family.
    """
    if not is_any(address.host):
        return address
    if interface is None:
        return address._replace(host=loopback_of(address.host))

    from router.net.kernel import interface_address

    if (host := interface_address(interface, family(address.host))) is None:
        kind = "IPv6" if address.is_ipv6 else "IPv4"
        raise UsageError(f"network interface '{interface}' is not there, or has no {kind} address to send to")
    return address._replace(host=host)


def listener_address(listener: Listener) -> Address:
    """Return the address that reaches a listener of the table from this computer. Raises UsageError."""
    return reachable(_of_udp(listener.address.value, listener.name), listener.interface)


def peer_names(table: RouteTable | None) -> Callable[[tuple[str, int]], str]:
    """Return a function from a peer's address to its endpoint's name, else to the address as text."""
    from router.compiler.network import recognisers

    by_host, by_address = recognisers(table, None) if table is not None else ({}, {})

    def name_of(peer: tuple[str, int]) -> str:
        return by_address.get(peer) or by_host.get(peer[0]) or str(Address(*peer))

    return name_of


def endpoint_of(text: str, table: RouteTable | None) -> Endpoint | None:
    """Return the endpoint of the table with this name."""
    return table.endpoints.get(text) if table is not None else None


def open_udp(address: Address, purpose: str, endpoint: Endpoint | None = None) -> socket.socket:
    """Open a non-blocking UDP socket bound to this address. Raises UsageError; `purpose` begins its message.

    `endpoint`: has this address; if it is a multicast group, the socket shares the port and receives the group.
    """
    from router.net.kernel import allow_fragments, why_not_bound

    opened = open_socket(address.host, socket.SOCK_DGRAM)
    try:
        opened.setblocking(False)
        allow_fragments(opened)
        if endpoint is not None and endpoint.group is not None:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            _join(opened, address.host, endpoint.interface)
        opened.bind(socket_address(*address))
    except OSError as error:
        opened.close()
        _, why, remedy = why_not_bound("udp", address.port, error)
        raise UsageError(f"{purpose}: cannot bind {address}: {why}", remedy) from error
    return opened


def _join(opened: socket.socket, group: str, interface: str | None) -> None:
    """Join a group until the socket is closed. Raises UsageError or OSError."""
    from router.net.multicast import Groups

    groups = Groups(opened, interface)
    groups.follow([group])
    if groups.missing:
        raise UsageError(f"cannot join {group}: {groups.missing[group]}")


def aim(sender: socket.socket, to: Endpoint) -> None:
    """Have a socket send to an endpoint that may be a multicast group or a broadcast address. Raises UsageError."""
    from router.net import multicast

    sender.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, to.broadcast is not None)
    if to.group is not None and not multicast.aim(sender, to.interface, to.hops or 1, is_looped=True):
        raise UsageError(f"cannot send to '{to.name}': there is no network interface '{to.interface}'")


def address_of(opened: socket.socket) -> Address:
    """Return the address that a socket of `open_udp` has."""
    return Address(*bound_address(opened))


def _split(text: str) -> tuple[str, str | None]:
    """Split `HOST[:PORT]` (with a port, an IPv6 host is in brackets). The port is None if there is none."""
    if text.startswith("["):
        host, closing, port = text[1:].partition("]")
        is_host_of_port = closing and is_ipv6(host) and port[:1] in ("", ":")
        return (host, port[1:] if port else None) if is_host_of_port else (text, None)
    host, colon, port = text.rpartition(":")
    return (host, port) if colon and not is_host(text) else (text, None)


def _named(text: str, table: RouteTable | None) -> Address | None:
    if table is None:
        return None
    if (endpoint := table.endpoints.get(text)) is not None:
        return place_of(endpoint, table)
    listener = table.listeners.get(text)
    return None if listener is None else _of_udp(listener.address.value, text)


def place_of(endpoint: Endpoint, table: RouteTable) -> Address:
    """Return the UDP address of an endpoint, with an IP address in place of a host name.

    Raises UsageError for the other end of a link, and for an address that is learned.
    """
    address = _of_udp(endpoint.address.value, endpoint.name)
    if address.is_learned:
        what = "the table has no address of this endpoint: a running router learns it"
        raise UsageError(what, "write HOST:PORT; `router status` shows the one that was learned")
    if not address.is_name:
        return address

    from router.compiler.network import fitting

    return address._replace(host=_resolve(address.host, fitting(table, endpoint)))


def _of_udp(address: Address, name: str) -> Address:
    """Return the address of a name of the table. Raises UsageError for a link."""
    if isinstance(address, LinkPlace):
        raise UsageError(f"'{name}' is at {address}, but this works over UDP only")
    return address


def _refuse_port_of_name(host: str, port: str, table: RouteTable | None) -> None:
    """Raise UsageError for a name of the table with a port, such as `sensor_board:5001`."""
    if (named := _named(host, table)) is not None:
        hint = f"write {host} alone, or its host with another port: {bracketed(named.host)}:{port}"
        raise UsageError(f"'{host}' is a name of the route table, which takes no port", hint)


def _not_a_place(text: str, table: RouteTable | None, form: str) -> UsageError:
    if is_ipv6(text) and is_host(text):
        return UsageError(f"'{text}' is not {form}", "write an IPv6 address in brackets: [fd00::30]:5000")
    if table is None:
        return UsageError(f"'{text}' is not {form}")
    hint = did_you_mean(text, (*table.endpoints, *table.listeners))
    return UsageError(f"'{text}' is neither {form} nor a name of the route table", hint)


def _resolve(host: str, kinds: Collection[bool] = (False, True)) -> str:
    """Return the first IP address of a host. `kinds`: what `is_ipv6` may be. Raises UsageError."""
    if is_ipv6(host):
        try:
            return parse_ipv6(host)
        except BadAddressError as error:
            raise UsageError(error.what, error.hint) from error
    try:
        found = [each for each in addresses_of(host) if is_ipv6(each) in kinds]
    except OSError as error:
        raise UsageError(f"no IP address for '{host}': {error.strerror}") from error
    if not found:
        raise UsageError(f"no {'IPv6' if True in kinds else 'IPv4'} address for '{host}', as its listener needs")
    return found[0]


def _port(text: str, lowest: int) -> int:
    if not text.isdigit() or not lowest <= int(text) <= 65535:
        raise UsageError(f"'{text}' is not a port", f"ports are {lowest} to 65535")
    return int(text)


def paced(count: int | None, rate: float | None) -> Iterator[float]:
    """Yield the seconds since the first time, `count` times (None: without end) at `rate` Hz (None: at once)."""
    start = time.monotonic()
    for index in itertools.count() if count is None else range(count):
        now = time.monotonic()
        if rate is not None and (wait := start + index / rate - now) > 0:
            time.sleep(wait)
            now = time.monotonic()
        yield now - start


@dataclass(slots=True)
class Sent:
    """Datagrams sent, and the seconds from the first to the last.

    `refused` counts ICMP answers that the port is closed, which may arrive late.
    """

    count: int = 0
    seconds: float = 0.0
    refused: int = 0

    @property
    def rate(self) -> float:
        """Datagrams per second; 0 for a single one."""
        return (self.count - 1) / self.seconds if self.seconds > 0 else 0.0


def send(sender: socket.socket, to: Address, data: bytes, count: int | None, rate: float | None, sent: Sent) -> None:
    """Send `count` times (None: until interrupted) at `rate` Hz (None: at once), counting in `sent`.

    The caller owns `sent`, which is also valid after an interrupt. Raises TransportError.
    """
    connect(sender, to)
    try:
        for elapsed in paced(count, rate):
            sent.refused += send_once(sender, data)
            sent.count += 1
            sent.seconds = elapsed
    except OSError as error:
        raise cannot_send(to, error) from error
    if sender.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
        sent.refused += 1


def connect(sender: socket.socket, to: Address) -> None:
    """Connect a socket of `open_udp`, which blocks from then on. Raises TransportError."""
    try:
        sender.setblocking(True)
        sender.connect(socket_address(*to))
    except OSError as error:
        raise cannot_send(to, error) from error


def cannot_send(to: Address, error: OSError) -> TransportError:
    is_away = error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH)
    remedy = "check that it is switched on, and that this computer is in its network" if is_away else ""
    return TransportError(f"cannot send to {to}: {error.strerror}", remedy)


def send_once(sender: socket.socket, data: bytes) -> int:
    """Send on a connected socket. If that reports that an earlier datagram was refused, send again and return 1."""
    try:
        sender.send(data)
    except ConnectionRefusedError:
        with contextlib.suppress(ConnectionRefusedError):  # reported for another one in between
            sender.send(data)
        return 1
    return 0

"""UDP for the tools: addresses as typed or named in a table, sockets, and a datagram sent once or at a rate."""

from __future__ import annotations

import contextlib
import errno
import itertools
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.errors import TransportError, UsageError, did_you_mean
from router.table.addresses import Address, LinkPlace

if TYPE_CHECKING:
    from router.table.model import RouteTable
    from router.table.model.endpoints import Endpoint, Listener
    from router.types.protobuf import Envelope
    from router.types.table_envelopes import Envelopes

ANY_HOST = "0.0.0.0"
LOOPBACK = "127.0.0.1"
ANYWHERE = Address(ANY_HOST, 0)
"""Any local address and port, chosen by the kernel."""


def destination(text: str, table: RouteTable | None) -> Address:
    """Parse `HOST:PORT`, or the name of an endpoint or listener of the table. Raises UsageError."""
    if table is not None and text in table.listeners and text not in table.endpoints:
        return listener_address(table.listeners[text])
    if (named := _named(text, table)) is not None:
        return reachable(named)
    host, colon, port = text.rpartition(":")
    if not colon or not host:
        raise _not_a_place(text, table, "HOST:PORT")
    _refuse_port_of_name(host, text, table)
    return Address(_resolve(host), _port(port, lowest=1))


def listening(text: str, table: RouteTable | None) -> Address:
    """Parse `[HOST:]PORT` (without a host, all local addresses), or a name of the table. Raises UsageError."""
    if (named := _named(text, table)) is not None:
        return named
    host, _, port = text.rpartition(":")
    if not port.isdigit():
        raise _not_a_place(text, table, "[HOST:]PORT")
    _refuse_port_of_name(host, text, table)
    return Address(_resolve(host) if host else ANY_HOST, _port(port, lowest=0))


def received_at(address: Address, table: RouteTable, envelopes: Envelopes) -> Envelope:
    """Return the envelope that an endpoint or listener with this address receives, by default the first one."""
    hosts = (address.host, ANY_HOST)
    for endpoint in table.endpoints.values():
        if endpoint.address.value == address or (
            address.host == ANY_HOST and endpoint.address.value.port == address.port
        ):
            return envelopes.to(endpoint.name)
    for listener in table.listeners.values():
        if listener.address.value.port == address.port and listener.address.value.host in hosts:
            return envelopes.at(listener.name)
    return envelopes.first


def origin(text: str, table: RouteTable | None) -> Address:
    """Parse `HOST[:PORT]`, or an endpoint's name: its host, and its `source_port` if it has one. Raises UsageError."""
    if table is not None and text in table.endpoints:
        endpoint = table.endpoints[text]
        address = _of_udp(endpoint.address.value, text)
        own = ANYWHERE if address.is_learned else located(address)
        return own._replace(port=endpoint.source_port.value if endpoint.source_port else 0)
    host, colon, port = text.partition(":")
    if not colon and table is not None and not host[:1].isdigit() and host != "localhost":
        raise _not_a_place(text, table, "HOST[:PORT]")
    if colon:
        _refuse_port_of_name(host, text, table)
    return Address(_resolve(host), _port(port, lowest=0) if colon else 0)


def reachable(address: Address, interface: str | None = None) -> Address:
    """Return the address that reaches a socket bound to `address` and `interface`, from this computer.

    Raises UsageError if the interface has no IPv4 address.
    """
    if address.host != ANY_HOST:
        return address
    if interface is None:
        return address._replace(host=LOOPBACK)

    from router.net.kernel import interface_address

    if (host := interface_address(interface)) is None:
        raise UsageError(f"network interface '{interface}' is not there, or has no IPv4 address to send to")
    return address._replace(host=host)


def listener_address(listener: Listener) -> Address:
    """Return the address that reaches a listener of the table from this computer. Raises UsageError."""
    return reachable(_of_udp(listener.address.value, listener.name), listener.interface)


def peer_names(table: RouteTable | None) -> Callable[[tuple[str, int]], str]:
    """Return a function from a peer's address to its endpoint's name, else to the address as text."""
    from router.compiler.network import recognisers

    by_host, by_address = recognisers(table.endpoints if table is not None else {}, None)

    def name_of(peer: tuple[str, int]) -> str:
        return by_address.get(peer) or by_host.get(peer[0]) or f"{peer[0]}:{peer[1]}"

    return name_of


def endpoint_of(text: str, table: RouteTable | None) -> Endpoint | None:
    """Return the endpoint of the table with this name."""
    return table.endpoints.get(text) if table is not None else None


def open_udp(address: Address, purpose: str, endpoint: Endpoint | None = None) -> socket.socket:
    """Open a non-blocking UDP socket bound to this address. Raises UsageError; `purpose` begins its message.

    `endpoint`: has this address; if it is a multicast group, the socket shares the port and receives the group.
    """
    from router.net.kernel import allow_fragments, why_not_bound

    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.setblocking(False)
        allow_fragments(opened)
        if endpoint is not None and endpoint.group is not None:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            _join(opened, address.host, endpoint.interface)
        opened.bind(address)
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


def _named(text: str, table: RouteTable | None) -> Address | None:
    if table is None:
        return None
    named = table.endpoints.get(text) or table.listeners.get(text)
    return None if named is None else located(_of_udp(named.address.value, text))


def located(address: Address) -> Address:
    """Return an address with an IPv4 address in place of its host name. Raises UsageError for one that is learned."""
    if address.is_learned:
        what = "the table has no address of this endpoint: a running router learns it"
        raise UsageError(what, "write HOST:PORT; `router status` shows the one that was learned")
    return address._replace(host=_resolve(address.host)) if address.is_name else address


def _of_udp(address: Address, name: str) -> Address:
    """Return the address of a name of the table. Raises UsageError for a link."""
    if isinstance(address, LinkPlace):
        raise UsageError(f"'{name}' is at {address}, but this works over UDP only")
    return address


def _refuse_port_of_name(host: str, text: str, table: RouteTable | None) -> None:
    """Raise UsageError for a name of the table with a port, such as `sensor_board:5001`."""
    if (named := _named(host, table)) is not None:
        _, _, port = text.rpartition(":")
        hint = f"write {host} alone, or its host with another port: {named.host}:{port}"
        raise UsageError(f"'{host}' is a name of the route table, which takes no port", hint)


def _not_a_place(text: str, table: RouteTable | None, form: str) -> UsageError:
    if table is None:
        return UsageError(f"'{text}' is not {form}")
    hint = did_you_mean(text, (*table.endpoints, *table.listeners))
    return UsageError(f"'{text}' is neither {form} nor a name of the route table", hint)


def _resolve(host: str) -> str:
    try:
        addresses = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    except OSError as error:
        raise UsageError(f"no IPv4 address for '{host}': {error.strerror}") from error
    return str(addresses[0][4][0])


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
        sender.connect(to)
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

"""Who is who on the network: which listeners receive from an endpoint, where datagrams to it leave, and how it is
recognised.
"""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from typing import TypeAlias

from router.hosts import ANY_HOST, is_any, is_ipv6, is_loopback
from router.table.addresses import Address, IPNetwork, LinkPlace, SerialPlace
from router.table.model import RouteTable
from router.table.model.endpoints import EPHEMERAL, Endpoint, EndpointKind, Listener

Cast: TypeAlias = tuple[str | None, int, bool] | str | None
"""How a sender reaches several machines: interface, hops and loop of a group, "broadcast", or None for one machine."""

ON_LINE = ANY_HOST, 0
"""The address that a frame of a serial line counts as coming from."""


def is_at(endpoint: Endpoint, listener: Listener) -> bool:
    return endpoint.listener is not None and endpoint.listener.value == listener.name


def is_on_link(endpoint: Endpoint) -> bool:
    return isinstance(endpoint.address.value, LinkPlace)


def takes_from(listener: Listener, host: str) -> bool:
    """Return whether a listener can receive from an IP address: a socket only from those of its family."""
    return listener.link is not None or listener.address.value.is_ipv6 == is_ipv6(host)


def reaches(address: Address, own: Address) -> bool:
    """Return whether datagrams to an address arrive at a listener of this computer."""
    if address.port != own.port or address.is_ipv6 != own.is_ipv6:
        return False
    return address.host == own.host or is_any(address.host) or (is_any(own.host) and is_loopback(address.host))


def sent_from(table: RouteTable, endpoint: Endpoint) -> str | None:
    """Return the listener whose address and port datagrams to an endpoint are sent from; None for a separate port. For
    the other end of a link, return that listener.

    Listeners that differ only in their interfaces share one address and port.
    """
    if endpoint.send_from is not None:
        return None if endpoint.send_from.value == EPHEMERAL else endpoint.send_from.value
    if endpoint.listener is not None:
        return endpoint.listener.value
    families = fitting(table, endpoint)
    listeners = [each for each in table.sockets if each.address.value.is_ipv6 in families]
    places = {each.address.value for each in listeners}
    return listeners[0].name if len(places) == 1 else None


def fitting(table: RouteTable, endpoint: Endpoint) -> AbstractSet[bool]:
    """Return whether the address of an endpoint is an IPv6 one; both if it is not known yet and may be either."""
    address = endpoint.address.value
    if address.is_known:
        return {address.is_ipv6}
    named = [each.value for each in (endpoint.listener, endpoint.send_from) if each is not None]
    own = {listener.address.value.is_ipv6 for listener in table.sockets if listener.name in named}
    return own or {listener.address.value.is_ipv6 for listener in table.sockets} or {False, True}


def sent_by(endpoint: Endpoint) -> tuple[str, int]:
    """Return the address that datagrams of an endpoint come from. On a serial line, it is ON_LINE; over TCP, the port
    is 0.
    """
    address = endpoint.address.value
    if isinstance(address, LinkPlace):
        return ON_LINE if isinstance(address, SerialPlace) else (address.host, 0)
    return address.host, endpoint.source_port.value if endpoint.source_port else address.port


def arrival(table: RouteTable, listener: str, peer: tuple[str, int], sender: str) -> tuple[str, tuple[str, int]] | None:
    """Return listener and address at which a table receives what another one has received so from an endpoint.

    They differ if only one of the tables has `sender` at a link. None: this table does not receive it.
    """
    endpoint, place = table.endpoints.get(sender), table.listeners.get(listener)
    if endpoint is not None and is_on_link(endpoint) and endpoint.listener is not None:
        return endpoint.listener.value, sent_by(endpoint)
    if place is not None and (place.line is not None) == (peer == ON_LINE):
        return listener, peer
    if endpoint is None or not endpoint.address.value.is_known or peer != ON_LINE:
        return None
    if endpoint.listener is not None:
        return endpoint.listener.value, sent_by(endpoint)
    taking = [each.name for each in table.sockets if takes_from(each, endpoint.address.value.host)]
    return (taking[0], sent_by(endpoint)) if taking else None


def destination(table: RouteTable, endpoint: Endpoint) -> tuple[tuple[str, int], bool, Cast]:
    """Return what the sender of an endpoint depends on: its address, whether it is a board, and its cast.

    The cast of a multicast group is the network interface, the number of hops, and whether the datagrams also reach
    sockets of this computer: unless a listener of the table would receive them.
    """
    host, port = endpoint.address.value
    cast: Cast = "broadcast" if endpoint.broadcast is not None else None
    if endpoint.group is not None:
        own = (each for each in table.listeners.values() if each.address.value.port == port)
        cast = endpoint.interface, endpoint.hops or 1, all(host not in each.group_hosts for each in own)
    return (host, port), endpoint.kind is EndpointKind.BOARD, cast


def recognisers(table: RouteTable, listener: str | None) -> tuple[dict[str, str], dict[tuple[str, int], str]]:
    """Return the names of endpoints by IP address, and by (IP address, port), for datagrams that `listener` receives.

    Endpoints of other listeners are omitted, or of all links if `listener` is None, and those whose address is not
    known; without a listener of their own, endpoints are recognised by all UDP sockets for their kind of IP address: in
    native code, the number of an IPv6 address could pass for an IPv4 sender's. An IP address that several endpoints
    share without source ports identifies none of them; this is only valid if none is a source.
    """
    by_address: dict[tuple[str, int], str] = {}
    by_host: dict[str, list[str]] = {}
    endpoints, place = table.endpoints.values(), table.listeners.get(listener or "")
    links = {each.listener.value for each in endpoints if each.listener and is_on_link(each)}
    for endpoint in endpoints:
        own = endpoint.listener.value if endpoint.listener is not None else None
        if own != listener and (listener in links or own in links or None not in (own, listener)):
            continue
        if endpoint.address.value.is_name or endpoint.address.value.is_learned:
            continue
        host, _ = sent_by(endpoint)
        if place is not None and not takes_from(place, host):
            continue
        if endpoint.source_port is not None:
            by_address[host, endpoint.source_port.value] = endpoint.name
        else:
            by_host.setdefault(host, []).append(endpoint.name)
    return {host: names[0] for host, names in by_host.items() if len(names) == 1}, by_address


def may_learn(table: RouteTable, endpoint: Endpoint, listener: Listener) -> bool:
    """Return whether the address of an endpoint may be learned from some sender at a listener."""
    networks = networks_of(table, endpoint)
    here = endpoint.listener is None or is_at(endpoint, listener)
    return here and (not networks or bool(networks_of(table, endpoint, listener)))


def networks_of(table: RouteTable, endpoint: Endpoint, listener: Listener | None = None) -> Sequence[IPNetwork]:
    """Return the networks in which the address of an endpoint may be learned, at a listener or at all; none for any."""
    networks = endpoint.networks or (table.networks.members if table.networks is not None else ())
    if listener is None:
        return networks
    return [each for each in networks if (each.version == 6) == listener.address.value.is_ipv6]

"""Multicast: groups that listening sockets join, and how sockets send to groups, by the index of a network interface.

A socket takes groups of its own address family only.

A head start uses this, so it imports only small modules.
"""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Collection

from router.hosts import is_ipv6, packed
from router.net.addresses import family, interface_index
from router.net.kernel import IP_MULTICAST_ALL, IPV6_MULTICAST_ALL

# Of <linux/netlink.h> and <linux/rtnetlink.h>.
_RTM_NEWROUTE, _RTM_GETROUTE = 24, 26
_NLM_F_REQUEST = 1
_RTA_DST, _RTA_OIF = 1, 4
_HEADER = struct.Struct("=IHHII")
_ROUTE = struct.Struct("=8BI")
_ATTRIBUTE = struct.Struct("=HH")
_INDEX = struct.Struct("=I")

_OF_IPV4 = socket.IPPROTO_IP, IP_MULTICAST_ALL, socket.IP_ADD_MEMBERSHIP, socket.IP_DROP_MEMBERSHIP
_OF_IPV6 = socket.IPPROTO_IPV6, IPV6_MULTICAST_ALL, socket.IPV6_JOIN_GROUP, socket.IPV6_LEAVE_GROUP
"""The level of the options of groups, and the options: receive all groups, join one, and leave one."""

NO_INTERFACE = "there is no such network interface"
NO_ROUTE = "no route leads to the group, and no interface is named for it"


def route_index(host: str) -> int | None:
    """Return the index of the network interface to which the routes of this computer send an IP address, or None."""
    address = packed(host)
    attribute = _ATTRIBUTE.pack(_ATTRIBUTE.size + len(address), _RTA_DST) + address
    body = _ROUTE.pack(family(host), 8 * len(address), 0, 0, 0, 0, 0, 0, 0) + attribute
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asking:
        asking.send(_HEADER.pack(_HEADER.size + len(body), _RTM_GETROUTE, _NLM_F_REQUEST, 1, 0) + body)
        answer = asking.recv(4096)
    length, kind, *_ = _HEADER.unpack_from(answer)
    if kind != _RTM_NEWROUTE:
        return None
    at = _HEADER.size + _ROUTE.size
    while at < length:
        size, what = _ATTRIBUTE.unpack_from(answer, at)
        if what == _RTA_OIF:
            return int(_INDEX.unpack_from(answer, at + _ATTRIBUTE.size)[0])
        at += (size + 3) & ~3
    return None


def _is_interface(index: int) -> bool:
    try:
        socket.if_indextoname(index)
    except OSError:
        return False
    return True


def wanted_index(group: str, interface: str | None) -> int | None:
    """Return the interface on which to join a group or send to it: the named one, else that of the route to it."""
    return route_index(group) if interface is None else interface_index(interface)


def aim(opened: socket.socket, interface: str | None, hops: int, is_looped: bool) -> bool:
    """Have a socket send to groups through a network interface; without one, through that of the route to the group.

    Return whether the interface is there; the socket sends elsewhere until it has been there once. After it was
    removed and has come back, do this again. `hops` is the number of networks that a datagram may pass. `is_looped`:
    also to sockets of this computer.
    """
    is_v6 = opened.family == socket.AF_INET6  # may nevertheless send to an IPv4 group
    opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, hops)
    opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, is_looped)
    if is_v6:
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, hops)
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_LOOP, is_looped)
    if interface is None:
        return True
    if (index := interface_index(interface)) is None:
        return False
    opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _membership("0.0.0.0", index))
    if is_v6:
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
    return True


class Groups:
    """The groups of one socket, which receives datagrams to these groups only. Use it in one thread at a time.

    `missing` are the groups that are not joined now, each with the reason. Other threads may read it.
    """

    def __init__(self, opened: socket.socket, interface: str | None) -> None:
        self._socket = opened
        is_v6 = opened.family == socket.AF_INET6
        self._level, self._every, self._add, self._drop = _OF_IPV6 if is_v6 else _OF_IPV4
        self._interface = interface
        self._joined: dict[str, int] = {}
        self.missing: dict[str, str] = {}

    def follow(self, wanted: Collection[str]) -> None:
        """Join the `wanted` groups that are not joined on their interfaces, and leave the others. Raises OSError."""
        # Otherwise the socket also gets the groups that other programs have joined.
        self._socket.setsockopt(self._level, self._every, 0 if wanted else 1)
        for group in self._joined.keys() - wanted:
            self._leave(group)
        missing = {group: self._join(group) for group in wanted}
        self.missing = {group: why for group, why in missing.items() if why}

    def _join(self, group: str) -> str:
        """Join a group on its present interface. Return why that is impossible, or ""."""
        joined, index = self._joined.get(group), wanted_index(group, self._interface)
        if index is None:
            if joined is not None and _is_interface(joined):
                return ""  # only the route is gone
            if joined is not None:
                self._leave(group)
            return NO_INTERFACE if self._interface is not None else NO_ROUTE
        if joined == index:
            return ""
        if joined is not None:
            self._leave(group)
        try:
            self._socket.setsockopt(self._level, self._add, _membership(group, index))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:  # the socket was inherited with it
                return error.strerror or str(error)
        self._joined[group] = index
        return ""

    def _leave(self, group: str) -> None:
        membership = _membership(group, self._joined.pop(group))
        self._socket.setsockopt(self._level, self._drop, membership)


def _membership(group: str, index: int) -> bytes:
    """Return a struct ip_mreqn, or a struct ipv6_mreq."""
    between = 0 if is_ipv6(group) else 4
    return packed(group) + bytes(between) + struct.pack("@i", index)

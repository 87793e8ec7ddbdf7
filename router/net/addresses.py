"""IP addresses for sockets, and for native code (`native/hosts.h`). A head start uses this, so it imports little."""

from __future__ import annotations

import errno
import os
import socket
import struct
from functools import cache

from router.hosts import FIRST_IPV6, LAST_IPV6, host_number, is_ipv6, packed, with_port, zone

TYPE_CHECKING = False
if TYPE_CHECKING:
    import ctypes
    from typing import Any


def family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if is_ipv6(host) else socket.AF_INET


def open_socket(host: str, kind: socket.SocketKind) -> socket.socket:
    """Return a new socket of the family of a host. An IPv6 one takes no IPv4."""
    opened = socket.socket(family(host), kind)
    if is_ipv6(host):
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    return opened


def interface_index(name: str) -> int | None:
    """Return the index of a network interface, or None. One that was removed and has come back has another index."""
    try:
        return socket.if_nametoindex(name)
    except OSError:
        return None


def _zone_index(host: str) -> int | None:
    """Return the index of the interface in an IPv6 address, 0 without one; None if there is no such interface."""
    name = zone(host)
    return interface_index(name) if name else 0


def socket_address(host: str, port: int) -> tuple[str, int] | tuple[str, int, int, int]:
    """Return an address for the socket module, which ignores the zone in a host.

    Raises OSError (ENODEV) if there is no such interface.
    """
    if not is_ipv6(host):
        return host, port
    index = _zone_index(host)
    if index is None:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    return host.partition("%")[0], port, 0, index


def host_and_port(address: tuple[Any, ...]) -> tuple[str, int]:
    """Return host and port of an address from the socket module, the opposite of `socket_address`.

    The zone is `?` if its interface is gone.
    """
    host, port, *rest = address
    if len(rest) < 2 or not rest[1]:
        return host, port
    try:
        return f"{host}%{socket.if_indextoname(rest[1])}", port
    except OSError:
        return f"{host}%?", port


def bound_address(opened: socket.socket) -> tuple[str, int]:
    """Return the address and port that a socket is bound to."""
    return host_and_port(opened.getsockname())


def addresses_of(host: str) -> list[str]:
    """Return the IP addresses of a host name, IPv4 first. It may take as long as the resolver does. Raises OSError."""
    found = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)
    return sorted((host_and_port(address)[0] for *_, address in found), key=is_ipv6)


def seen(library: ctypes.CDLL, host: str) -> int:
    """Return the number that a sender at an address has: that of a stranger if it is another address's."""
    if not is_ipv6(host):
        return host_number(host)
    sockaddr_in6 = struct.pack("=HHI16sI", socket.AF_INET6, 0, 0, packed(host), _zone_index(host) or 0)
    return int(library.host_number_ipv6(sockaddr_in6))


def know(library: ctypes.CDLL, host: str) -> int:
    """Return the number of an address, and have a library know the address, at its present interface.

    Raises MemoryError.
    """
    if is_ipv6(host) and not library.host_add(packed(host), _zone_index(host) or 0):
        raise MemoryError(f"there is no number left for the address {host}: restart the router")
    return host_number(host)


@cache
def _ipv4(number: int) -> str:
    return socket.inet_ntoa(number.to_bytes(4, "big"))


def host_text(number: int) -> str:
    """Return the address that has a number in this process; `::` if it is not known."""
    if not FIRST_IPV6 - 1 <= number <= LAST_IPV6:
        return _ipv4(number)
    import ctypes

    from router.declared import HOST_TEXT
    from router.library import library

    text = ctypes.create_string_buffer(HOST_TEXT)
    library().host_text(number, text)
    return text.value.decode()


def origin_text(origin: int) -> str:
    """Return an address and port, as native code packs them, as text."""
    return with_port(host_text(origin >> 16), origin & 0xFFFF)

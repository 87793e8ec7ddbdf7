"""IP addresses as text, and the numbers that native code has for them (`native/hosts.h`).

IPv6 addresses are in their shortest form without brackets; link-local ones end with `%` and a network interface. A head
start uses this, so it imports little.
"""

from __future__ import annotations

ANY_HOST, ANY_IPV6 = "0.0.0.0", "::"
LOOPBACK, LOOPBACK_IPV6 = "127.0.0.1", "::1"
FIRST_IPV6, LAST_IPV6 = 0xF0000001, 0xFFFFFFFE
"""The numbers of IPv6 addresses."""


def is_ipv6(host: str) -> bool:
    return ":" in host


def is_address(host: str) -> bool:
    """Return whether it is an IP address, not a name."""
    return is_ipv6(host) or host.replace(".", "").isdigit()


def is_any(host: str) -> bool:
    """Return whether it stands for all addresses of this computer, of its family."""
    return host in (ANY_HOST, ANY_IPV6)


def any_of(host: str) -> str:
    """Return what stands for all addresses of this computer, of the family of a host."""
    return ANY_IPV6 if is_ipv6(host) else ANY_HOST


def loopback_of(host: str) -> str:
    """Return an address through which this computer reaches itself, of the family of a host."""
    return LOOPBACK_IPV6 if is_ipv6(host) else LOOPBACK


def is_loopback(host: str) -> bool:
    return host == LOOPBACK_IPV6 or (host.startswith("127.") and not is_ipv6(host))


def zone(host: str) -> str:
    """Return the network interface of a link-local IPv6 address, or ""."""
    return host.partition("%")[2]


def bracketed(host: str) -> str:
    """Return an address as it is written before a port."""
    return f"[{host}]" if is_ipv6(host) else host


def with_port(host: str, port: int) -> str:
    return f"{bracketed(host)}:{port}"


def packed(host: str) -> bytes:
    """Return the bytes of an IP address, without a zone."""
    if not is_ipv6(host):
        return bytes(map(int, host.split(".")))
    from ipaddress import IPv6Address  # few tables need it

    return IPv6Address(host.partition("%")[0]).packed


def as_ipv6(host: str) -> bytes:
    """Return the 16 bytes of an IP address, an IPv4 one as IPv4-mapped."""
    return packed(host) if is_ipv6(host) else bytes(10) + b"\xff\xff" + packed(host)


def host_number(host: str) -> int:
    """Return an IP address as a number."""
    if not is_ipv6(host):
        return int.from_bytes(packed(host), "big")
    hashed = 2166136261  # FNV-1a
    for byte in packed(host):
        hashed = (hashed ^ byte) * 16777619 & 0xFFFFFFFF
    return FIRST_IPV6 + hashed % (LAST_IPV6 - FIRST_IPV6 + 1)

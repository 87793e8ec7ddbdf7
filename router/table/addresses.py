"""Addresses of a table: strict parsing of IPv4 literals with a port, and the check that they lie in `networks`.

Only endpoints may have host names, which the running router resolves: a table compiles alike on every machine.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from router.errors import Code, Diagnostic
from router.table.nodes import MappingNode, Node, Path, ScalarNode, SequenceNode
from router.table.units import Quantity

if TYPE_CHECKING:
    from router.table.model import Networks


class Address(NamedTuple):
    """An IPv4 address and a UDP (for metrics: TCP) port. That of an endpoint may be a host name, or LEARNED."""

    host: str
    port: int

    @property
    def is_name(self) -> bool:
        """Whether the host is a name that is not resolved."""
        return not self.is_known and not self.is_learned

    @property
    def is_learned(self) -> bool:
        """Whether the address is that of whoever sends first."""
        return self == LEARNED

    @property
    def is_known(self) -> bool:
        """Whether it is an IPv4 address."""
        return self.host.replace(".", "").isdigit()

    def __str__(self) -> str:
        return self.host if self.is_learned else f"{self.host}:{self.port}"


LEARNED = Address("learned", 0)


class LinkPlace(Address):
    """The other end of a link, in the place of an address."""

    @property
    def is_name(self) -> bool:
        return False


class TcpPlace(LinkPlace):
    """The other end of a TCP connection; its port is 0 if it connects to the router."""

    def __str__(self) -> str:
        return f"tcp {self.host}:{self.port}" if self.port else f"tcp {self.host}"


class SerialPlace(LinkPlace):
    """The other end of a serial line: `host` is the device."""

    def __str__(self) -> str:
        return self.host


_EXAMPLE = "write an IPv4 address and a port, such as 192.168.0.30:8"
_NO_MULTICAST = "write the address of one machine; for several, an endpoint has `group` or `broadcast` instead"
_NO_LOCAL_MULTICAST = "write an address of this machine, or 0.0.0.0 for all of them"
_LABEL = "[A-Za-z0-9](?:[A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
NAME = re.compile(rf"(?:{_LABEL}\.)*(?=[A-Za-z]){_LABEL}")
"""A host name. Its last part begins with a letter, so it is no misspelt IPv4 address."""
_LONGEST_NAME = 253
_NUMBERS = re.compile(r"[0-9]+(?:\.[0-9]+)*")

LOCATOR = re.compile(r"(?P<protocol>[a-z]+/)(?P<address>[^?#]*)(?P<rest>(?:[?#].*)?)")
"""A Zenoh locator: tcp/192.168.0.10:7447. The part after the address cannot name another machine."""


class BadAddressError(ValueError):
    """A text is not an address. `what` says why, `hint` what to do about it."""

    def __init__(self, what: str, hint: str = _EXAMPLE) -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint


def parse_address(text: str) -> Address:
    """Parse an address. Raises BadAddressError."""
    host, colon, port = text.rpartition(":")
    if not colon or _is_ipv4(port):
        raise no_port(text)
    if not host:
        raise BadAddressError(f"'{text}' has no IP address")
    if ":" in host:
        raise BadAddressError(f"'{host}' is not an IPv4 address", f"{_EXAMPLE}: IPv6 is not supported")
    if not _is_ipv4(host):
        raise _bad_host(host)
    if not re.fullmatch("[0-9]{1,5}", port) or not 1 <= int(port) <= 65535 or port[0] == "0":
        raise BadAddressError(f"the port '{port}' is not a number from 1 to 65535")
    return Address(host, int(port))


def no_port(text: str) -> BadAddressError:
    return BadAddressError(f"'{text}' has no port")


def parse_remote(text: str) -> Address:
    """Parse the address of a single machine, as a destination. Raises BadAddressError."""
    address = parse_address(text)
    if _first(address) == 0 or _first(address) >= 224:
        raise not_one_machine(address)
    return address


def parse_endpoint(text: str) -> Address:
    """Parse the address of a single machine, its host name and a port, or `learned`. Raises BadAddressError.

    An IP address without a port is a TcpPlace.
    """
    if text == LEARNED.host:
        return LEARNED
    if _is_ipv4(text):
        return TcpPlace(parse_remote(f"{text}:1").host, 0)
    host, _, port = text.rpartition(":")
    if NAME.fullmatch(host) and len(host) <= _LONGEST_NAME:
        return Address(host.lower(), parse_address(f"127.0.0.1:{port}").port)
    if host and ":" not in host and not _NUMBERS.fullmatch(host):
        what = f"'{host}' is neither an IPv4 address nor a host name"
        raise BadAddressError(what, "write an address and a port, such as 192.168.0.30:8 or robot3.local:8")
    return parse_remote(text)


def not_one_machine(address: Address) -> BadAddressError:
    return BadAddressError(f"{address.host} is not the address of a single machine", _NO_MULTICAST)


def parse_local(text: str) -> Address:
    """Parse an address of this machine, or 0.0.0.0 for all of them. Raises BadAddressError."""
    address = parse_address(text)
    if _first(address) >= 224:
        raise BadAddressError(f"{address.host} cannot be an address of this machine", _NO_LOCAL_MULTICAST)
    return address


def parse_group(text: str) -> Address:
    """Parse a multicast group with its port. Raises BadAddressError."""
    address = parse_address(text)
    if not 224 <= _first(address) <= 239:
        what = f"{address.host} is not a multicast group"
        raise BadAddressError(what, "write a group from 224.0.0.0 to 239.255.255.255, and a port")
    return address


def parse_broadcast(text: str) -> Address:
    """Parse an address that may be a broadcast address, which depends on the networks. Raises BadAddressError."""
    address = parse_address(text)
    if _first(address) == 0 or (_first(address) >= 224 and address.host != "255.255.255.255"):
        what = f"{address.host} is not the broadcast address of a network"
        raise BadAddressError(what, "write it as `ip address` shows it after 'brd', and a port")
    return address


REMOTE = Quantity("address", parse_remote, str)
ENDPOINT = Quantity("endpoint_address", parse_endpoint, str)
GROUP = Quantity("address", parse_group, str)
BROADCAST = Quantity("address", parse_broadcast, str)
LOCAL = Quantity("address", parse_local, str)


def _first(address: Address) -> int:
    return int(address.host.partition(".")[0])


def _is_ipv4(text: str) -> bool:
    parts = text.split(".")
    return len(parts) == 4 and all(map(_is_octet, parts))


def _is_octet(text: str) -> bool:
    return re.fullmatch("[0-9]{1,3}", text) is not None and int(text) <= 255 and str(int(text)) == text


def _bad_host(host: str) -> BadAddressError:
    if not _NUMBERS.fullmatch(host):
        example = "127.0.0.1" if host == "localhost" else "an IPv4 address such as 192.168.0.30"
        hint = f"write {example}: only endpoints may have host names"
        return BadAddressError(f"'{host}' is not an IPv4 address", hint)
    parts = host.split(".")
    if len(parts) != 4:
        return BadAddressError(f"'{host}' has {len(parts)} numbers where an IPv4 address has four")
    wrong = next(part for part in parts if not _is_octet(part))
    return BadAddressError(f"'{wrong}' in '{host}' must be a number from 0 to 255 without leading zeros")


ADDRESSES: tuple[Path, ...] = (
    ("http", "address"),
    ("foxglove", "address"),
    *(("listen", "*", name) for name in ("address", "connect", "accept")),
    ("listen", "*", "groups", "*"),
    *(("endpoints", "*", name) for name in ("address", "group", "broadcast")),
    ("gateways", "*", "receive"),
    *(("gateways", "*", "transport", name) for name in ("udp", "tcp", "websocket")),
    *(("gateways", "*", "transport", "zenoh", name, "*") for name in ("connect", "listen")),
)
"""Paths of all addresses in a table; `*` is any name, or any item of a list."""


def outside_findings(root: MappingNode, networks: Networks, files: Sequence[str]) -> Iterator[Diagnostic]:
    """Yield findings for addresses outside `networks`. `files` are the table's, each before the one that it extends."""
    extended = files[files.index(networks.span.file) + 1 :]
    for pattern in ADDRESSES:
        for path, node in _found(root, pattern, ()):
            if not node.broken:
                yield from _outside(path, node, networks, node.span.file in extended)


def _found(node: Node, pattern: Path, here: Path) -> Iterator[tuple[Path, ScalarNode]]:
    if not pattern:
        if isinstance(node, ScalarNode):
            yield here, node
    elif isinstance(node, MappingNode):
        for name, entry in node.entries.items():
            if pattern[0] in ("*", name):
                yield from _found(entry.value, pattern[1:], (*here, name))
    elif isinstance(node, SequenceNode) and pattern[0] == "*":
        for item in node.items:
            yield from _found(item, pattern[1:], here)


def _outside(path: Path, node: ScalarNode, networks: Networks, is_extended: bool) -> Iterator[Diagnostic]:
    is_locator, is_client = "zenoh" in path[3:], path[0] == "endpoints" and _is_ipv4(node.text)
    locator = LOCATOR.fullmatch(node.text) if is_locator else None
    name, key = ".".join(map(str, path[:-1])), path[-1]
    if key in ("group", "groups"):
        yield from _group_outside(f"'{key}' of {name}", node, networks)
        return
    try:
        address = parse_address(locator["address"] if locator else f"{node.text}:1" if is_client else node.text)
    except BadAddressError:
        # A host name, IPv6, a path; invalid addresses of other kinds already have a finding.
        if is_locator or NAME.fullmatch(node.text.rpartition(":")[0]):
            what = f"'{node.text}' under '{key}' of {name} has no IPv4 address to compare with {networks}"
            remedy = _remedy(path, "tcp/127.0.0.1:7447" if is_locator else "127.0.0.1:8", networks, is_extended)
            yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, what, remedy)
        return
    host = ipaddress.IPv4Address(address.host)
    if any(host in network for network in networks.members):
        return
    which = "which includes more than" if address.host == "0.0.0.0" else "outside"
    port = "" if is_client else f":{address.port}"
    what = f"'{key}' of {name} is {address.host}{port}, {which} {networks}"
    nearest = f"{_moved(host, networks.members[0])}{port}"
    example = f"{locator['protocol']}{nearest}{locator['rest']}" if locator else nearest
    yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, what, _remedy(path, example, networks, is_extended))


def _group_outside(what: str, node: ScalarNode, networks: Networks) -> Iterator[Diagnostic]:
    host, _, _ = node.text.partition(":")
    if not any(ipaddress.IPv4Address(host) in network for network in networks.members):
        hint = f"remove it, or add {host}/32 to `networks`: the group may have members in any network"
        yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, f"{what} is {node.text}, outside {networks}", hint)


def _moved(host: ipaddress.IPv4Address, network: ipaddress.IPv4Network) -> ipaddress.IPv4Address:
    """Return the address in a network with the host part of `host`; for host part 0, the first host."""
    number = int(host) & int(network.hostmask)
    return network.network_address + (number or min(1, network.num_addresses - 1))


def _remedy(path: Path, example: str, networks: Networks, is_extended: bool) -> str:
    if not is_extended:
        return f"write an address inside them, such as {example}"
    said = f"[{example}]" if "zenoh" in path[3:] else example
    for key in reversed(path):
        said = f"{key}: {said}" if key == path[0] else f"{{{key}: {said}}}"
    return f"override it in {networks.span.file}, for example with {said}"

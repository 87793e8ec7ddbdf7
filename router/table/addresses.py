"""Addresses of a table: strict parsing of IP addresses with a port, and the check that they lie in `networks`.

Only endpoints may have host names, which the running router resolves: a table compiles alike on every machine.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from router.errors import Code, Diagnostic
from router.hosts import is_address, is_any, is_ipv6, with_port
from router.table.nodes import MappingNode, Node, Path, ScalarNode, SequenceNode
from router.table.units import Quantity

if TYPE_CHECKING:
    from router.table.model import Networks


IPNetwork: TypeAlias = ipaddress.IPv4Network | ipaddress.IPv6Network


class Address(NamedTuple):
    """An IP address and a UDP (for metrics: TCP) port. That of an endpoint may be a host name, or LEARNED.

    IPv6 addresses are as in `router.hosts`.
    """

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
        """Whether it is an IP address."""
        return is_address(self.host)

    @property
    def is_ipv6(self) -> bool:
        return is_ipv6(self.host)

    def __str__(self) -> str:
        return self.host if self.is_learned else with_port(self.host, self.port)


LEARNED = Address("learned", 0)


def in_yaml(address: Address | str) -> str:
    """Return an address as a table has it: with quotes if it has brackets."""
    return f'"{address}"' if "[" in str(address) else str(address)


class LinkPlace(Address):
    """The other end of a link, in the place of an address."""

    @property
    def is_name(self) -> bool:
        return False


class TcpPlace(LinkPlace):
    """The other end of a TCP connection; its port is 0 if it connects to the router."""

    def __str__(self) -> str:
        return f"tcp {super().__str__()}" if self.port else f"tcp {self.host}"


class SerialPlace(LinkPlace):
    """The other end of a serial line: `host` is the device."""

    @property
    def is_known(self) -> bool:
        return False

    @property
    def is_ipv6(self) -> bool:
        return False

    def __str__(self) -> str:
        return self.host


_EXAMPLE = "write an IP address and a port, such as 192.168.0.30:8 or '[fd00::30]:8'"
_IPV6_EXAMPLE = "write an IPv6 address in brackets and a port, such as '[fd00::30]:8'"
_IPV6_FORM = "write eight hexadecimal numbers with ':' between them, and '::' at most once in place of zeros"
_NO_MULTICAST = "write the address of one machine; for several, an endpoint has `group` or `broadcast` instead"
_NO_LOCAL_MULTICAST = "write an address of this machine; 0.0.0.0 or [::] are all of them"
_GROUPS = "write a group from 224.0.0.0 to 239.255.255.255 or in ff00::/8"
_LABEL = "[A-Za-z0-9](?:[A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
NAME = re.compile(rf"(?:{_LABEL}\.)*(?=[A-Za-z]){_LABEL}")
"""A host name. Its last part begins with a letter, so it is no misspelt IPv4 address."""
_LONGEST_NAME = 253
_INTERFACE = re.compile(r"(?!\.{1,2}$)[A-Za-z0-9_.-]{1,15}")
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
    if text.startswith("["):
        return _parse_ipv6(text)
    host, colon, port = text.rpartition(":")
    if not colon or _is_ipv4(port):
        raise no_port(text)
    if not host:
        raise BadAddressError(f"'{text}' has no IP address")
    if is_ipv6(host):
        what = f"'{text}' is neither an IPv4 address with a port nor an IPv6 address in brackets"
        raise BadAddressError(what, _IPV6_EXAMPLE)
    if not _is_ipv4(host):
        raise _bad_host(host)
    return Address(host, _port(port))


def _parse_ipv6(text: str) -> Address:
    host, closing, port = text[1:].partition("]")
    if not closing or not port.startswith(":"):
        raise no_port(text)
    return Address(parse_ipv6(host), _port(port[1:]))


def parse_ipv6(text: str) -> str:
    """Parse an IPv6 address without brackets, and return it in its shortest form. Raises BadAddressError."""
    try:
        found = ipaddress.IPv6Address(text)
    except ValueError as error:
        raise BadAddressError(f"'{text}' is not an IPv6 address", _IPV6_FORM) from error
    if found.ipv4_mapped is not None:
        raise BadAddressError(f"{text} is the IPv4 address {found.ipv4_mapped}", f"write {found.ipv4_mapped}")
    host = str(found).partition("%")[0]
    interface = found.scope_id
    if not found.is_link_local:
        if interface is None:
            return host
        raise BadAddressError(f"{text} has a network interface, but is not link-local", f"write {host}")
    if interface is None:
        hint = f"write its network interface behind it, such as {host}%eth0"
        raise BadAddressError(f"{host} is link-local, and each network interface has such addresses", hint)
    if not _INTERFACE.fullmatch(interface):
        raise BadAddressError(f"'{interface}' in {text} is not the name of a network interface", f"write {host}%eth0")
    return f"{host}%{interface}"


def _port(text: str) -> int:
    if not re.fullmatch("[0-9]{1,5}", text) or not 1 <= int(text) <= 65535 or text[0] == "0":
        raise BadAddressError(f"the port '{text}' is not a number from 1 to 65535")
    return int(text)


def no_port(text: str) -> BadAddressError:
    return BadAddressError(f"'{text}' has no port", _IPV6_EXAMPLE if is_ipv6(text) else _EXAMPLE)


def parse_remote(text: str) -> Address:
    """Parse the address of a single machine, as a destination. Raises BadAddressError."""
    address = parse_address(text)
    host = _parsed(address)
    if host.is_unspecified or host.is_multicast or (host.version == 4 and not 0 < _first(address) < 224):
        raise not_one_machine(address)
    return address


def parse_endpoint(text: str) -> Address:
    """Parse the address of a single machine, its host name and a port, or `learned`. Raises BadAddressError.

    An IP address without a port is a TcpPlace.
    """
    if text == LEARNED.host:
        return LEARNED
    if is_host(text):
        return TcpPlace(parse_remote(with_port(text, 1)).host, 0)
    host, _, port = text.rpartition(":")
    if NAME.fullmatch(host) and len(host) <= _LONGEST_NAME:
        return Address(host.lower(), parse_address(f"127.0.0.1:{port}").port)
    if host and ":" not in host and not _NUMBERS.fullmatch(host):
        what = f"'{host}' is neither an IP address nor a host name"
        raise BadAddressError(what, "write an address and a port, such as 192.168.0.30:8 or robot3.local:8")
    return parse_remote(text)


def not_one_machine(address: Address) -> BadAddressError:
    return BadAddressError(f"{address.host} is not the address of a single machine", _NO_MULTICAST)


def parse_local(text: str) -> Address:
    """Parse an address of this machine, or 0.0.0.0 or [::] for all of them. Raises BadAddressError."""
    address = parse_address(text)
    if _parsed(address).is_multicast or (not address.is_ipv6 and _first(address) >= 224):
        raise BadAddressError(f"{address.host} cannot be an address of this machine", _NO_LOCAL_MULTICAST)
    return address


def parse_group(text: str) -> Address:
    """Parse a multicast group with its port. Raises BadAddressError."""
    address = parse_address(text)
    if not _parsed(address).is_multicast:
        what = f"{address.host} is not a multicast group"
        raise BadAddressError(what, f"{_GROUPS}, and a port")
    return address


def parse_joined(text: str) -> str:
    """Parse a multicast group without a port. Raises BadAddressError."""
    host = parse_ipv6(text) if is_ipv6(text) else text
    if not ipaddress.ip_address(host).is_multicast:
        raise BadAddressError(f"{host} is not a multicast group", _GROUPS)
    return host


def parse_broadcast(text: str) -> Address:
    """Parse an address that may be a broadcast address, which depends on the networks. Raises BadAddressError."""
    address = parse_address(text)
    if address.is_ipv6:
        raise BadAddressError(f"{address.host} is not a broadcast address: IPv6 has none", "write a 'group' instead")
    if _first(address) == 0 or (_first(address) >= 224 and address.host != "255.255.255.255"):
        what = f"{address.host} is not the broadcast address of a network"
        raise BadAddressError(what, "write it as `ip address` shows it after 'brd', and a port")
    return address


REMOTE = Quantity("address", parse_remote, str)
ENDPOINT = Quantity("endpoint_address", parse_endpoint, str)
GROUP = Quantity("address", parse_group, str)
JOINED = Quantity("group", parse_joined, str)
BROADCAST = Quantity("address", parse_broadcast, str)
LOCAL = Quantity("address", parse_local, str)


def _parsed(address: Address) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    return ipaddress.ip_address(address.host)


def _first(address: Address) -> int:
    """Return the first number of an IPv4 address."""
    return int(address.host.partition(".")[0])


def is_host(text: str) -> bool:
    """Whether a text is an IP address without a port."""
    return _is_ipv4(text) or (text.count(":") > 1 and not text.startswith("["))


def _is_ipv4(text: str) -> bool:
    parts = text.split(".")
    return len(parts) == 4 and all(map(_is_octet, parts))


def _is_octet(text: str) -> bool:
    return re.fullmatch("[0-9]{1,3}", text) is not None and int(text) <= 255 and str(int(text)) == text


def _bad_host(host: str) -> BadAddressError:
    if not _NUMBERS.fullmatch(host):
        example = "127.0.0.1" if host == "localhost" else "one such as 192.168.0.30"
        hint = f"write {example}: only endpoints may have host names"
        return BadAddressError(f"'{host}' is not an IP address", hint)
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
    is_locator = "zenoh" in path[3:]
    locator = LOCATOR.fullmatch(node.text) if is_locator else None
    has_port = path[0] != "endpoints" or not is_host(node.text)
    name, key = ".".join(map(str, path[:-1])), path[-1]
    try:
        if key in ("group", "groups"):
            group = node.text if key == "groups" else parse_group(node.text).host
            yield from _group_outside(f"'{key}' of {name}", node, group, networks)
            return
        address = parse_address(
            locator["address"] if locator else node.text if has_port else with_port(node.text, 1)
        )
    except BadAddressError:
        # A host name, a path; invalid addresses of other kinds already have a finding.
        if is_locator or NAME.fullmatch(node.text.rpartition(":")[0]):
            what = f"'{node.text}' under '{key}' of {name} has no IP address to compare with {networks}"
            example = _nearest(ipaddress.IPv4Address("127.0.0.1"), networks, 7447 if is_locator else 8)
            remedy = _remedy(path, f"tcp/{example}" if is_locator else example, networks, is_extended)
            yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, what, remedy)
        return
    host = _parsed(address)
    if any(host in network and (not is_any(address.host) or network.prefixlen == 0) for network in networks.members):
        return
    which = "which includes more than" if is_any(address.host) else "outside"
    what = f"'{key}' of {name} is {address if has_port else address.host}, {which} {networks}"
    nearest = _nearest(host, networks, address.port if has_port else None)
    example = f"{locator['protocol']}{nearest}{locator['rest']}" if locator else nearest
    yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, what, _remedy(path, example, networks, is_extended))


def _group_outside(what: str, node: ScalarNode, group: str, networks: Networks) -> Iterator[Diagnostic]:
    host = ipaddress.ip_address(group)
    if not any(host in network for network in networks.members):
        hint = f"remove it, or add {host}/{host.max_prefixlen} to `networks`: the group may have members in any network"
        yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, f"{what} is {node.text}, outside {networks}", hint)


def _nearest(host: ipaddress.IPv4Address | ipaddress.IPv6Address, networks: Networks, port: int | None) -> str:
    """Return an address in the first of the networks, of the family of `host` if there is one, with the host part of
    `host`; for host part 0, the first host.
    """
    alike = [each for each in networks.members if each.version == host.version]
    network = (alike or networks.members)[0]
    number = int(host) & int(network.hostmask) if alike else 0
    found = network.network_address + (number or min(1, network.num_addresses - 1))
    text = f"{found}%eth0" if found.version == 6 and found.is_link_local else str(found)
    return text if port is None else str(Address(text, port))


def _remedy(path: Path, example: str, networks: Networks, is_extended: bool) -> str:
    written = in_yaml(example)
    if not is_extended:
        return f"write an address inside them, such as {written}"
    said = f"[{written}]" if "zenoh" in path[3:] else written
    for key in reversed(path):
        said = f"{key}: {said}" if key == path[0] else f"{{{key}: {said}}}"
    return f"override it in {networks.span.file}, for example with {said}"

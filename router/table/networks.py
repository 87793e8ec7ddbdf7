"""`networks`: each address of a table lies in one of these, or is an error. No name is looked up."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Sequence

from router.errors import Code, Diagnostic
from router.table.address import LOCATOR, BadAddressError, parse_address
from router.table.model import Networks
from router.table.nodes import MappingNode, Node, Path, ScalarNode, SequenceNode

ADDRESSES: tuple[Path, ...] = (
    ("metrics", "address"),
    ("foxglove", "address"),
    ("listen", "*", "address"),
    ("endpoints", "*", "address"),
    ("gateways", "*", "receive"),
    *(("gateways", "*", "transport", name) for name in ("udp", "tcp", "websocket")),
    *(("gateways", "*", "transport", "zenoh", name, "*") for name in ("connect", "listen")),
)
"""Where addresses stand in a table; `*` is any name, or any item of a list."""


def outside_findings(root: MappingNode, networks: Networks, files: Sequence[str]) -> Iterator[Diagnostic]:
    """`files` are those of the table, each before the one that it extends."""
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
    name, key = ".".join(map(str, path[:-1])), path[-1]
    try:
        address = parse_address(locator["address"] if locator else node.text)
    except BadAddressError:
        if is_locator:  # a host name, IPv6, a path; other addresses have this finding already
            what = f"'{node.text}' under '{key}' of {name} has no IPv4 address that could lie in {networks}"
            remedy = _remedy(path, "tcp/127.0.0.1:7447", networks, is_extended)
            yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, what, remedy)
        return
    host = ipaddress.IPv4Address(address.host)
    if any(host in network for network in networks.members):
        return
    which = "all networks of this machine, which is more than" if address.host == "0.0.0.0" else "outside"
    what = f"'{key}' of {name} is {address}, {which} {networks}"
    nearest = f"{_moved(host, networks.members[0])}:{address.port}"
    example = f"{locator['protocol']}{nearest}{locator['rest']}" if locator else nearest
    yield Diagnostic(node.span, Code.OUTSIDE_NETWORKS, what, _remedy(path, example, networks, is_extended))


def _moved(host: ipaddress.IPv4Address, network: ipaddress.IPv4Network) -> ipaddress.IPv4Address:
    """The host of this number in a network; of number 0, which is no host, the first."""
    number = int(host) & int(network.hostmask)
    return network.network_address + (number or min(1, network.num_addresses - 1))


def _remedy(path: Path, example: str, networks: Networks, is_extended: bool) -> str:
    if not is_extended:
        return f"write one that lies there, such as {example}"
    said = f"[{example}]" if "zenoh" in path[3:] else example
    for key in reversed(path):
        said = f"{key}: {said}" if key == path[0] else f"{{{key}: {said}}}"
    return f"give it one in {networks.span.file}, such as {said}"

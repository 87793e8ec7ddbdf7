"""The UDP ports of DDS: a listener at one keeps ROS processes from finding each other, or finds the port taken."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from router.compiler.compiled_table import CompiledTable
from router.errors import SourceSpan
from router.net.kernel import FIRST_OF_ROS
from router.table.addresses import Address

_FIRST, _OF_DOMAIN = 7400, 250
"""Domain D has the ports from 7400 + 250 D on. The first one is for multicast discovery, which all processes share."""

_FLOWS = range(FIRST_OF_ROS, 7100)
"""Fast DDS binds one more port per ROS process, in every domain: the first free one from 7000 on."""

_EVERYWHERE = frozenset({"", "SUBNET", "SYSTEM_DEFAULT"})


class Clash(NamedTuple):
    """A UDP address of the table with a port of DDS. `blinds`: no ROS process on this computer discovers others."""

    owner: str
    span: SourceSpan
    address: Address
    domain: int
    blinds: bool

    def __str__(self) -> str:
        if self.blinds:
            why = f"the port through which ROS processes of domain {self.domain} find each other"
            return f"{self.owner} has {self.address}, {why}: those that start on this computer find nobody"
        return f"{self.owner} has {self.address}, a port that a ROS process of this computer may take first"


def clashes(program: CompiledTable, variables: Mapping[str, str]) -> Iterator[Clash]:
    """Yield the UDP addresses of listeners and gateways with a port of DDS in the domain of the environment."""
    if (domain := _domain(variables)) is None:
        return
    addresses = [(f"listener '{listener.name}'", listener.address) for listener in program.table.sockets]
    for name, gateway in program.table.gateways.items():
        addresses += [(f"gateway '{name}'", gateway.receive)] if gateway.receive is not None else []
    for owner, address in addresses:
        if not address.value.is_ipv6 and is_of_ros(address.value.port, variables):  # DDS has the IPv4 port
            blinds = address.value.port == _FIRST + _OF_DOMAIN * domain
            yield Clash(owner, address.span, address.value, domain, blinds)


def is_of_ros(port: int, variables: Mapping[str, str]) -> bool:
    """Return whether ROS processes with this environment may take a UDP port."""
    if (domain := _domain(variables)) is None:
        return False
    return port in _FLOWS or (port - _FIRST) // _OF_DOMAIN == domain


def _domain(variables: Mapping[str, str]) -> int | None:
    """Return the domain; None if there is none, or ROS does not use DDS."""
    domain = variables.get("ROS_DOMAIN_ID") or "0"
    is_dds = not variables.get("RMW_IMPLEMENTATION", "").startswith("rmw_zenoh")
    return int(domain) if is_dds and re.fullmatch("[0-9]{1,3}", domain) else None


def discovers_by_multicast(variables: Mapping[str, str]) -> bool:
    """Return whether ROS processes with this environment discover those on other computers."""
    discovery_range = variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return discovery_range in _EVERYWHERE and variables.get("ROS_LOCALHOST_ONLY") != "1"

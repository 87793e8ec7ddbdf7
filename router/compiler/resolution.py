"""Endpoints without a written address: host names, for which the running router finds addresses, and learned ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from ipaddress import ip_address

from router.compiler.compiled_table import CompiledTable
from router.compiler.network import fitting, networks_of, reaches, sent_by
from router.hosts import host_number, is_ipv6, with_port
from router.table.addresses import Address, BadAddressError, parse_remote
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint

PORT_IN_TESTS = 40_000
"""The port of a sender in tests that has no other."""

_LEARNED_HOST, _LEARNED_IPV6 = "198.19.0.1", "2001:2:0:1::1"
"""The host of endpoints whose address is learned, unless their networks exclude it: one for benchmarks."""


def names(program: CompiledTable) -> dict[str, str]:
    """Return the host names of a compiled table, by endpoint."""
    endpoints = (program.named or program).table.endpoints.values()
    return {each.name: each.address.value.host for each in endpoints if each.address.value.is_name}


def unresolved(table: RouteTable) -> list[str]:
    """Return the endpoints with a host name: nothing is sent to them, and nothing from them is recognised."""
    return [each.name for each in table.endpoints.values() if each.address.value.is_name]


def resolved(program: CompiledTable, hosts: Mapping[str, str]) -> CompiledTable:
    """Return a compiled table with the addresses of host names; names without one stay as they are."""
    named = program.named or program
    endpoints = {name: _at(endpoint, hosts) for name, endpoint in named.table.endpoints.items()}
    table = replace(named.table, endpoints=endpoints)
    return replace(named, table=table, senders=tuple(endpoints[each.name] for each in named.senders), named=named)


def _at(endpoint: Endpoint, hosts: Mapping[str, str]) -> Endpoint:
    address = endpoint.unicast
    if address is None or address.value.host not in hosts:
        return endpoint
    return replace(endpoint, unicast=replace(address, value=Address(hosts[address.value.host], address.value.port)))


def stand_in(table: RouteTable, endpoint: Endpoint, default: str) -> str:
    """Return a host from which the address of a learned endpoint may be learned: `default`, or else one that fits."""
    host = ip_address(default)
    networks = [each for each in networks_of(table, endpoint) if each.version == host.version]
    if not networks or any(host in network for network in networks):
        return default
    return str(next(iter(networks[0].hosts())))


def sender_in_tests(table: RouteTable, endpoint: Endpoint) -> tuple[str, int]:
    """Return the address that datagrams of an endpoint come from in tests; if it is learned, one that fits."""
    if not endpoint.address.value.is_learned:
        return sent_by(endpoint)
    host = _LEARNED_HOST if False in fitting(table, endpoint) else _LEARNED_IPV6
    return stand_in(table, endpoint, host), endpoint.source_port.value if endpoint.source_port else PORT_IN_TESTS


def with_stand_ins(program: CompiledTable) -> CompiledTable:
    """Return a compiled table for tests, in which each host name has an address of a network for benchmarks."""
    table = program.table
    only_ipv6 = {host for name, host in names(program).items() if False not in fitting(table, table.endpoints[name])}
    hosts = enumerate(dict.fromkeys(names(program).values()), 1)
    return resolved(
        program,
        {host: f"2001:2::{at:x}" if host in only_ipv6 else f"198.18.{at // 256}.{at % 256}" for at, host in hosts},
    )


def why_unusable(program: CompiledTable, name: str, host: str) -> str:
    """Return why an address cannot be that of the endpoints with a host name, or ""."""
    table = (program.named or program).table
    for endpoint in table.endpoints.values():
        address = endpoint.address.value
        if address.host != name:
            continue
        try:
            found = parse_remote(with_port(host, address.port))
        except BadAddressError as error:
            return error.what
        if found.is_ipv6 not in fitting(table, endpoint):
            return f"'{endpoint.name}' needs an IPv{4 if found.is_ipv6 else 6} address, like its listener's, not {host}"
        for listener in program.listeners:
            if reaches(found, listener.address.value):
                return f"{found} is the router's own listener '{listener.name}'"
    for other in program.table.endpoints.values() if is_ipv6(host) else ():
        known = other.address.value
        if known.is_ipv6 and known.host != host and host_number(known.host) == host_number(host):
            return f"the router cannot distinguish {host} from {known.host}: they have the same hash"
    return ""

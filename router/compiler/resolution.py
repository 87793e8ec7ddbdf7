"""Endpoints without a written address: host names, for which the running router finds addresses, and learned ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from ipaddress import IPv4Address

from router.compiler.compiled_table import CompiledTable
from router.compiler.network import networks_of, reaches
from router.table.addresses import Address, BadAddressError, parse_remote
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint


def names(program: CompiledTable) -> dict[str, str]:
    """Return the host names of a compiled table, by endpoint."""
    endpoints = (program.named or program).table.endpoints.values()
    return {each.name: each.address.value.host for each in endpoints if each.address.value.is_name}


def unresolved(table: RouteTable) -> list[str]:
    """Return the endpoints with a host name: nothing is sent to them, and nothing from them is recognised."""
    return [each.name for each in table.endpoints.values() if each.address.value.is_name]


def resolved(program: CompiledTable, hosts: Mapping[str, str]) -> CompiledTable:
    """Return a compiled table with the IPv4 addresses of host names; names without one stay as they are."""
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
    networks = networks_of(table, endpoint)
    if not networks or any(IPv4Address(default) in network for network in networks):
        return default
    return str(next(networks[0].hosts()))


def with_stand_ins(program: CompiledTable) -> CompiledTable:
    """Return a compiled table for tests, in which each host name has an address of a network for benchmarks."""
    hosts = dict.fromkeys(names(program).values())
    return resolved(program, {host: f"198.18.{at // 256}.{at % 256}" for at, host in enumerate(hosts, 1)})


def why_unusable(program: CompiledTable, name: str, host: str) -> str:
    """Return why an address cannot be that of the endpoints with a host name, or ""."""
    for endpoint in (program.named or program).table.endpoints.values():
        address = endpoint.address.value
        if address.host != name:
            continue
        try:
            parse_remote(f"{host}:{address.port}")
        except BadAddressError as error:
            return error.what
        for listener in program.listeners:
            if reaches(Address(host, address.port), listener.address.value):
                return f"{host}:{address.port} is the router's own listener '{listener.name}'"
    return ""

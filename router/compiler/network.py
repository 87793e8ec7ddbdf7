"""Who is who on the network: clashes between addresses, and destinations that lead back to the router."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from itertools import combinations

from router.errors import Code, Diagnostic, SourceSpan
from router.table.model import Address, Endpoint, Listener, RouteTable

WILDCARD = "0.0.0.0"
LOOPBACK = "127."


def network_findings(table: RouteTable) -> Iterator[Diagnostic]:
    for first, second in combinations(table.listeners.values(), 2):
        if _overlap(first.address.value, second.address.value):
            message = f"listener '{second.name}' has the address of listener '{first.name}'"
            hint = "one socket takes it all; give it a port of its own"
            yield Diagnostic(second.address.span, Code.ADDRESS_CLASH, message, hint)
    sources = {source.value for route in table.routes for source in route.sources}
    blamed: set[str] = set()
    for one, other in combinations(table.endpoints.values(), 2):
        if other.name not in blamed and (clash := _clash(one, other, sources)):
            blamed.add(other.name)
            yield clash


def _overlap(one: Address, other: Address) -> bool:
    return one.port == other.port and (one.host == other.host or WILDCARD in (one.host, other.host))


def _clash(one: Endpoint, other: Endpoint, sources: set[str]) -> Diagnostic | None:
    """Two endpoints that a received datagram could both be from."""
    if one.address.value.host != other.address.value.host or not sources & {one.name, other.name}:
        return None
    host = one.address.value.host
    if one.source_port is None or other.source_port is None:
        message = f"endpoints '{one.name}' and '{other.name}' share the address {host}"
        hint = "an endpoint is recognised by its address: correct it, or give both a 'source_port'"
        return Diagnostic(other.address.span, Code.ADDRESS_CLASH, message, hint)
    if one.source_port.value == other.source_port.value:
        message = f"endpoints '{one.name}' and '{other.name}' share the address {host} and the source port"
        return Diagnostic(other.source_port.span, Code.ADDRESS_CLASH, message, "give each its own source_port")
    return None


def loop_finding(
    table: RouteTable, endpoint: Endpoint, span: SourceSpan, case: str, sources: AbstractSet[str]
) -> Diagnostic | None:
    """A destination at `span` to which payloads of `case` from `sources` are sent: back to one, or to the router."""
    if endpoint.name in sources:
        message = f"'{endpoint.name}' would get its own '{case}' back"
        return Diagnostic(span, Code.FORWARDING_LOOP, message, "remove it from the destinations or from the source")
    for listener in table.listeners.values():
        if _reaches(endpoint.address.value, listener):
            message = f"'{endpoint.name}' is the router's own listener '{listener.name}' ({endpoint.address.value})"
            return Diagnostic(span, Code.FORWARDING_LOOP, message, "the router would receive what it sends for ever")
    return None


def _reaches(address: Address, listener: Listener) -> bool:
    own = listener.address.value
    if address.port != own.port:
        return False
    return address.host in (own.host, WILDCARD) or (own.host == WILDCARD and address.host.startswith(LOOPBACK))


def recognisers(endpoints: Mapping[str, Endpoint]) -> tuple[dict[str, str], dict[tuple[str, int], str]]:
    """How a sender's address becomes an endpoint's name: by IP address, and by (IP address, port).

    An IP address that several endpoints share without source ports recognises none of them; the table
    may have that only where none is a source.
    """
    by_address: dict[tuple[str, int], str] = {}
    by_host: dict[str, list[str]] = {}
    for endpoint in endpoints.values():
        host = endpoint.address.value.host
        if endpoint.source_port is not None:
            by_address[host, endpoint.source_port.value] = endpoint.name
        else:
            by_host.setdefault(host, []).append(endpoint.name)
    return {host: names[0] for host, names in by_host.items() if len(names) == 1}, by_address

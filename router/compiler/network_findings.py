"""Findings for addresses that clash, destinations that lead back to the router, and listeners that do not fit."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from itertools import combinations, product

from router.compiler.network import fitting, is_at, is_on_link, may_learn, reaches, takes_from
from router.errors import Code, Diagnostic, Located, SourceSpan, did_you_mean
from router.hosts import ANY_HOST, any_of, host_number, is_any, is_ipv6
from router.table.addresses import Address, IPNetwork, in_yaml
from router.table.model import RouteTable
from router.table.model.endpoints import EPHEMERAL, Endpoint, EndpointKind, Listener
from router.table.model.gateways import Gateway, Transport
from router.table.model.routes import ANY


@dataclass(frozen=True, slots=True)
class _LocalAddress:
    """A local address, with the name of its owner for findings. UDP and TCP addresses do not clash."""

    owner: str
    address: Located[Address]
    is_udp: bool = False
    interface: str | None = None


def network_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for the addresses of a table and for its listeners."""
    for first, second in combinations(_local_addresses(table), 2):
        if first.is_udp == second.is_udp and _overlap(first, second):
            message = f"{second.owner} uses the address of {first.owner}"
            hint = "use another port"
            if first.interface != second.interface:  # a socket without an interface receives on all interfaces
                hint += f", or give {second.owner if first.interface else first.owner} an 'interface'"
            hint += ": only one of them can receive there"
            yield Diagnostic(second.address.span, Code.ADDRESS_CLASH, message, hint)
    yield from _group_findings(table)
    yield from _several_machines(table)
    yield from _family_findings(table)
    yield from _number_findings(table)
    yield from _learned_findings(table)
    yield from _listener_findings(table)
    yield from _link_findings(table)
    for endpoint in table.endpoints.values():
        if endpoint.allow_non_finite and endpoint.kind is not EndpointKind.BOARD:
            message = f"'{endpoint.name}' is not a board, so it receives NaN and infinity anyway"
            yield Diagnostic(endpoint.span, Code.BAD_VALUE, message, "remove `allow_non_finite`")
    yield from _gateway_findings(table)
    sources = {source.value for route in table.routes for source in route.sources}
    reported: set[str] = set()
    for one, other in combinations(table.endpoints.values(), 2):
        if other.name not in reported and (clash := _clash(one, other, sources)):
            reported.add(other.name)
            yield clash


def _local_addresses(table: RouteTable) -> Iterator[_LocalAddress]:
    for listener in table.sockets:
        interface = listener.interface
        yield _LocalAddress(f"listener '{listener.name}'", listener.address, is_udp=True, interface=interface)
    for listener in table.links:
        if listener.accepts:
            yield _LocalAddress(f"listener '{listener.name}'", listener.address)
    if table.http is not None:
        yield _LocalAddress("'http'", table.http.address)
    if table.foxglove is not None:
        yield _LocalAddress("'foxglove'", table.foxglove.address)
    for gateway in table.gateways.values():
        owner = f"gateway '{gateway.name}'"
        if gateway.receive is not None:
            yield _LocalAddress(owner, gateway.receive, is_udp=True)
        if gateway.address is not None and gateway.transport.value is not Transport.UDP:
            yield _LocalAddress(owner, gateway.address)


def _gateway_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for gateways that send to the router itself, or have the same Zenoh key."""
    keys: dict[str, Gateway] = {}
    for gateway in table.gateways.values():
        if gateway.address is not None and gateway.transport.value is Transport.UDP:
            yield from _own_address(gateway, gateway.address, table)
            if gateway.receive is not None and gateway.receive.value.is_ipv6 != gateway.address.value.is_ipv6:
                kind, own = _kind(gateway.address.value), _kind(gateway.receive.value)
                message = f"'{gateway.name}' sends to an {kind} address, but would receive at an {own} one"
                hint = f"write an {kind} address of this computer"
                yield Diagnostic(gateway.receive.span, Code.BAD_VALUE, message, hint)
        if gateway.zenoh is not None:
            first = keys.setdefault(gateway.zenoh.key.value, gateway)
            if first is not gateway:
                message = f"gateway '{gateway.name}' uses the key of gateway '{first.name}'"
                yield Diagnostic(gateway.zenoh.key.span, Code.ADDRESS_CLASH, message, "choose another key")


def _own_address(gateway: Gateway, address: Located[Address], table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for a gateway that sends to a listener or gateway of this table: messages could loop endlessly."""
    own = {f"listener '{listener.name}'": listener.address.value for listener in table.sockets}
    for other in table.gateways.values():
        if other.receive is not None:
            own["'receive' address" if other is gateway else f"gateway '{other.name}'"] = other.receive.value
    for name, local in own.items():
        if reaches(address.value, local):
            message = f"'{gateway.name}' would send to the router's own {name} ({address.value})"
            yield Diagnostic(address.span, Code.FORWARDING_LOOP, message, "write the address of its client")


def _overlap(one: _LocalAddress, other: _LocalAddress) -> bool:
    """Return whether two addresses overlap, so that the kernel cannot bind both. On two interfaces, they never do."""
    if one.interface and other.interface and one.interface != other.interface:
        return False
    first, second = one.address.value, other.address.value
    if first.port != second.port or first.is_ipv6 != second.is_ipv6:
        return False
    return first.host == second.host or is_any(first.host) or is_any(second.host)


def _group_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for listeners that would never receive the datagrams to their groups."""
    for listener in table.listeners.values():
        address = listener.address.value
        if listener.groups and not is_any(address.host):
            message = f"listener '{listener.name}' is at {address}, where the kernel delivers nothing to a group"
            hint = f"write {in_yaml(Address(any_of(address.host), address.port))}; 'interface' selects the network"
            yield Diagnostic(listener.address.span, Code.BAD_VALUE, message, hint)
        for group in listener.groups:
            if is_ipv6(group.value) != address.is_ipv6:
                message = f"listener '{listener.name}' at {address} receives {_kind(address)} only"
                hint = f"add a listener at {in_yaml(Address(any_of(group.value), address.port))} for {group.value}"
                yield Diagnostic(group.span, Code.BAD_VALUE, message, hint)


def _several_machines(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for groups and broadcast addresses that are used as one machine."""
    sources = {source.value: source.span for route in table.routes for source in route.sources}
    for endpoint in table.endpoints.values():
        if endpoint.is_one_machine:
            continue
        key = "group" if endpoint.group is not None else "broadcast"
        if endpoint.kind is EndpointKind.BOARD:
            message = f"'{endpoint.name}' is a board, but '{key}' sends to any number of machines"
            hint = "give each board an endpoint with its 'address': commands and deadmen are for known boards"
            yield Diagnostic(endpoint.address.span, Code.BAD_VALUE, message, hint)
        if endpoint.name in sources:
            message = f"'{endpoint.name}' cannot be a source: no datagram comes from the address of its '{key}'"
            hint = "name an endpoint with the 'address' of the sender"
            yield Diagnostic(sources[endpoint.name], Code.BAD_VALUE, message, hint)


def _kind(address: Address) -> str:
    return "IPv6" if address.is_ipv6 else "IPv4"


def _family_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for endpoints that have another kind of IP address than the listeners that they need."""
    heard, named = _heard(table), dict[str, Endpoint]()
    kinds = {listener.address.value.is_ipv6 for listener in table.sockets}
    for endpoint in table.endpoints.values():
        address = endpoint.address.value
        if findings := [*_other_kinds(table, endpoint)]:
            yield from findings
        elif is_on_link(endpoint) or address.is_learned or table.broken:
            continue
        elif address.is_name:
            first = named.setdefault(address.host, endpoint)
            if fitting(table, endpoint).isdisjoint(fitting(table, first)):
                message = f"'{first.name}' and '{endpoint.name}' need the IPv4 and the IPv6 address of {address.host}"
                hint = "give them listeners with one kind of address: a host name is resolved once"
                yield Diagnostic(endpoint.address.span, Code.BAD_VALUE, message, hint)
        elif endpoint.name in heard and kinds and address.is_ipv6 not in kinds:
            message = f"nothing from '{endpoint.name}' is received: no listener is at an {_kind(address)} address"
            place = in_yaml(Address(any_of(address.host), table.sockets[0].address.value.port))
            yield Diagnostic(endpoint.address.span, Code.BAD_VALUE, message, f"add one, such as {place}")


def _other_kinds(table: RouteTable, endpoint: Endpoint) -> Iterator[Diagnostic]:
    first = endpoint.address.value if endpoint.address.value.is_known else None
    for key, named in (("listener", endpoint.listener), ("send_from", endpoint.send_from)):
        listener = table.listeners.get(named.value) if named is not None else None
        if named is None or listener is None or listener.line is not None:
            continue
        own = listener.address.value
        if first is not None and first.is_ipv6 != own.is_ipv6:
            message = f"'{endpoint.name}' has an {_kind(first)} address, but its '{key}' an {_kind(own)} one"
            yield Diagnostic(named.span, Code.BAD_VALUE, message, f"name a listener at an {_kind(first)} address")
        first = own


def _number_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for IPv6 addresses that have the same number in native code."""
    first: dict[int, str] = {}
    addresses = [each.address for each in table.endpoints.values()] + [each.address for each in table.links]
    for address in addresses:
        host = address.value.host
        if address.value.is_ipv6 and (known := first.setdefault(host_number(host), host)) != host:
            message = f"the router cannot distinguish {host} from {known}: they have the same hash"
            yield Diagnostic(address.span, Code.ADDRESS_CLASH, message, "give one of them another address")


def _heard(table: RouteTable) -> set[str]:
    """Return the endpoints that routes and services receive from."""
    sources = {source.value for route in table.routes for source in route.sources}
    return sources | {called.source.source.value for called in table.called.values()}


def _learned_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for endpoints whose address is learned."""
    heard = _heard(table)
    for endpoint in table.endpoints.values():
        address = endpoint.address
        if not address.value.is_learned:
            continue
        if endpoint.kind is EndpointKind.BOARD and endpoint.because is None:
            message = f"'{endpoint.name}' is a board, but any computer may send first and get its commands and brakes"
            hint = "write the board's address, or say with `because` why nothing else can send to the listener"
            yield Diagnostic(address.span, Code.MISSING_KEY, message, hint)
        if endpoint.name not in heard and not table.broken:
            message = f"the address of '{endpoint.name}' is never learned: no route names it as its source"
            hint = "write a route for what it sends, or its address"
            yield Diagnostic(address.span, Code.BAD_VALUE, message, hint)
        for network in endpoint.networks:
            if table.networks and not any(_is_within(network, each) for each in table.networks.members):
                message = f"'networks' of endpoints.{endpoint.name} has {network}, outside {table.networks}"
                hint = "remove it: without 'networks', the endpoint has those of the table"
                yield Diagnostic(address.span, Code.OUTSIDE_NETWORKS, message, hint)
        listeners = [each for each in table.sockets if endpoint.listener is None or is_at(endpoint, each)]
        if listeners and not any(may_learn(table, endpoint, each) for each in listeners):
            kinds = " or ".join(sorted({_kind(each.address.value) for each in listeners}))
            message = f"the address of '{endpoint.name}' is never learned: its 'networks' have no {kinds} addresses"
            hint = f"add a network of {kinds}, or name another 'listener'"
            yield Diagnostic(address.span, Code.BAD_VALUE, message, hint)


def _is_within(network: IPNetwork, other: IPNetwork) -> bool:
    return network.prefixlen >= other.prefixlen and network.network_address in other


def _listener_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for unknown listeners of endpoints, and for listeners that accept no sending endpoint."""
    for endpoint in table.endpoints.values():
        for named, known in (
            (endpoint.listener, [*table.listeners]),
            (endpoint.send_from, [*table.listeners, EPHEMERAL]),
        ):
            if named and named.value not in known and not table.broken & {"listen", f"listen/{named.value}"}:
                hint = did_you_mean(named.value, known)
                yield Diagnostic(named.span, Code.UNKNOWN_LISTENER, f"there is no listener '{named.value}'", hint)
    sources = {source.value for route in table.routes for source in route.sources}
    senders = [endpoint for endpoint in table.endpoints.values() if endpoint.name in sources]
    nowhere = (
        each for each in senders if not each.listener and not any(_is_accepted(each, at) for at in table.sockets)
    )
    if not senders or ANY in sources or table.broken or next(nowhere, None):  # which has a finding
        return
    for listener in table.sockets:
        if not any(_is_accepted(endpoint, listener) for endpoint in senders):
            message = f"listener '{listener.name}' accepts none of the sending endpoints, so it rejects everything"
            hint = f"remove it, or give an endpoint 'listener: {listener.name}'"
            yield Diagnostic(listener.span, Code.UNUSED_LISTENER, message, hint)


def _link_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for serial lines that share a device, and for links without the right endpoints."""
    devices: dict[Address, Listener] = {}
    for line in table.lines:
        other = devices.setdefault(line.address.value, line)
        if other is not line:
            message = f"listener '{line.name}' uses the device of listener '{other.name}'"
            hint = "name another device: only one of them can open it"
            yield Diagnostic(line.address.span, Code.ADDRESS_CLASH, message, hint)
    for listener in table.links:
        assert listener.link is not None  # noqa: S101 - it is a link
        noun, at_its_end = listener.link.NOUN, [each for each in table.endpoints.values() if is_at(each, listener)]
        if not at_its_end and not table.broken:
            message = f"nobody is at the other end of the {noun} '{listener.name}'"
            hint = f"add an endpoint with `listener: {listener.name}` and "
            hint += "the IP address of its board" if listener.accepts else "without 'address'"
            yield Diagnostic(listener.span, Code.MISSING_KEY, message, hint)
        known: dict[str, Endpoint] = {}
        for each in at_its_end:
            if (first := known.setdefault(each.address.value.host, each)) is each:
                continue
            message = f"'{first.name}' and '{each.name}' are both at the other end of '{listener.name}'"
            hint = f"a {noun} has one endpoint{' for each address' * listener.accepts}: remove the other"
            yield Diagnostic(each.span, Code.ADDRESS_CLASH, message, hint)
    for endpoint in table.endpoints.values():
        yield from _misplaced(table, endpoint)


def _misplaced(table: RouteTable, endpoint: Endpoint) -> Iterator[Diagnostic]:
    """Yield findings for keys of an endpoint that are only for UDP or only for a link."""
    nouns = {listener.name: listener.link.NOUN for listener in table.links if listener.link is not None}
    if endpoint.send_from is not None and endpoint.send_from.value in nouns:
        noun = nouns[endpoint.send_from.value]
        message = f"'{endpoint.send_from.value}' is a {noun}, so no UDP datagrams leave from it"
        yield Diagnostic(endpoint.send_from.span, Code.BAD_VALUE, message, "name a listener with an address")
    if endpoint.listener is None or endpoint.listener.value not in nouns:
        return
    is_udp = not is_on_link(endpoint)
    spans = {
        "address": endpoint.address.span if is_udp else None,
        "source_port": endpoint.source_port.span if endpoint.source_port else None,
        "send_from": endpoint.send_from.span if endpoint.send_from else None,
    }
    for key, span in spans.items():
        if span is not None:
            noun = nouns[endpoint.listener.value]
            message = f"'{endpoint.name}' is at the other end of the {noun} '{endpoint.listener.value}'"
            yield Diagnostic(span, Code.BAD_VALUE, message, f"remove '{key}', which is for UDP")


def _is_accepted(endpoint: Endpoint, listener: Listener) -> bool:
    """Return whether a listener may receive datagrams from an endpoint."""
    if endpoint.listener is not None:
        return is_at(endpoint, listener)
    address = endpoint.address.value
    return not address.is_known or takes_from(listener, address.host)


def _clash(one: Endpoint, other: Endpoint, sources: set[str]) -> Diagnostic | None:
    """Return a finding if a received datagram could be from either endpoint."""
    if one.address.value.host != other.address.value.host or not sources & {one.name, other.name}:
        return None
    if is_on_link(one) or is_on_link(other):  # which have findings of their own
        return None
    if one.listener and other.listener and one.listener.value != other.listener.value:
        return None
    if one.address.value.is_learned:
        return _learned_clash(one, other)
    host = one.address.value.host
    if one.source_port is None or other.source_port is None:
        message = f"endpoints '{one.name}' and '{other.name}' share the address {host}"
        hint = "correct the address, or give each endpoint its own 'source_port'"
        if one.listener or other.listener:
            hint += " or 'listener'"
        return Diagnostic(other.address.span, Code.ADDRESS_CLASH, message, hint)
    if one.source_port.value == other.source_port.value:
        message = f"endpoints '{one.name}' and '{other.name}' share the address {host} and the source port"
        return Diagnostic(other.source_port.span, Code.ADDRESS_CLASH, message, "give each its own source_port")
    return None


def _learned_clash(one: Endpoint, other: Endpoint) -> Diagnostic | None:
    """Return a finding if both endpoints could be learned from one sender."""
    ports = [each.source_port.value for each in (one, other) if each.source_port is not None]
    pairs = product(one.networks, other.networks)
    if len({*ports}) > 1 or (one.networks and other.networks and not any(a.overlaps(b) for a, b in pairs)):
        return None
    message = f"a sender could be learned as '{one.name}' or as '{other.name}'"
    hint = "give each its own 'source_port', 'networks' or 'listener'"
    return Diagnostic(other.address.span, Code.ADDRESS_CLASH, message, hint)


def loop_finding(
    table: RouteTable, endpoint: Endpoint, span: SourceSpan, case: str, sources: AbstractSet[str]
) -> Diagnostic | None:
    """Return a finding if a destination, named at `span`, is one of `sources` of `case`, or the router itself."""
    if endpoint.name in sources:
        message = f"'{endpoint.name}' would get its own '{case}' back"
        return Diagnostic(span, Code.FORWARDING_LOOP, message, "remove it from the destinations or from the source")
    for listener in table.sockets:
        own = listener.address.value
        returns = endpoint.broadcast is not None and own == (ANY_HOST, endpoint.broadcast.value.port)
        if returns or reaches(endpoint.address.value, own):
            message = f"'{endpoint.name}' is the router's own listener '{listener.name}' ({endpoint.address.value})"
            hint = "remove it, or correct its address: datagrams would return to the router in an endless loop"
            return Diagnostic(span, Code.FORWARDING_LOOP, message, hint)
    return None

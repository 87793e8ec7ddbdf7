"""Build the typed route table from nodes that fit the schema. Parts with findings are left out and named in `broken`.

`structure` reads objects key by key, as the classes of the model declare them. Types with their own syntax have a
function here.
"""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from ipaddress import ip_network
from pathlib import Path
from typing import Any, TypeVar, Union

from router import inputs
from router.assets import asset
from router.errors import Code, Diagnostic, Located, SourceSpan, shown_path
from router.table.addresses import (
    LOCAL,
    REMOTE,
    Address,
    IPNetwork,
    LinkPlace,
    SerialPlace,
    TcpPlace,
    no_port,
)
from router.table.keys import Key, keys_of
from router.table.model import Networks, RouteTable
from router.table.model.endpoints import Endpoint, Framing, Listener
from router.table.model.expressions import Choices, Elements, Expression, FieldEntry, FieldMap
from router.table.model.gateways import (
    Gateway,
    GatewayFormat,
    IgnoredGateway,
    Inbound,
    InboundDeadman,
    InboundService,
    TopicPattern,
    TopicRate,
    Transport,
    ZenohConfig,
    ZenohSettings,
)
from router.table.model.routes import ROS, Deadman, Obeyed, Payload, Route
from router.table.model.serial import Checksum, ChecksumKind, SerialLine, StreamFraming
from router.table.model.services import CalledService, Service, ServiceRequest
from router.table.model.settings import EnvelopeSettings, NodeSettings, RecordSettings, ServerSettings
from router.table.model.state import State
from router.table.model.targets import Destination, Topic
from router.table.model.tcp import TcpClient, TcpServer
from router.table.nodes import (
    EACH,
    ELSE,
    FIELDS,
    MAP,
    TEXT,
    Entry,
    MappingNode,
    Node,
    ScalarNode,
    SequenceNode,
    TextSpan,
    is_valid,
    marked_broken,
    to_data,
    valid_part,
)
from router.table.nodes import Path as Steps
from router.table.reading import (
    InvalidValueError,
    beside,
    boolean,
    is_choice,
    is_elements,
    is_text,
    located,
    mapping,
    optional_text,
    parsed,
    scalar,
    sequence,
    whole,
)
from router.table.source import Source
from router.table.units import TOPIC_RATE

T = TypeVar("T")
M = TypeVar("M")

AUTO = "auto"
DEFAULT_FORMATS: Mapping[Transport, GatewayFormat] = {
    Transport.UDP: GatewayFormat.GATEWAY_V1,
    Transport.TCP: GatewayFormat.GATEWAY_V1,
    Transport.WEBSOCKET: GatewayFormat.JSON,
    Transport.ZENOH: GatewayFormat.GATEWAY_V1,
}


def build_table(root: MappingNode, sources: Sequence[Source], findings: list[Diagnostic]) -> RouteTable | None:
    """Build the table of all valid parts; None if the envelope or the routes as a whole are invalid or missing.

    Problems that the schema cannot detect, such as a buffer size that the kernel rejects, are added to `findings`.
    """
    builder = _Builder(findings)
    envelope = builder.one(root, "envelope", _envelope)
    envelopes = {"": envelope} if envelope else builder.each(root, "envelopes", _named_envelope)
    routes = root.entries.get("routes")
    endpoints = root.entries.get("endpoints")
    if not all(entry is None or isinstance(entry.value, MappingNode) for entry in (routes, endpoints)):
        return None
    if (not envelopes or routes is None) and not _has_gateways_only(root):
        return None
    listeners = builder.each(root, "listen", _listener)
    gateways = builder.each(root, "gateways", _gateway, salvage=valid_part)
    services = builder.each(root, "services", _service)
    defaults = root.get("defaults")
    if defaults is not None and defaults.broken:
        builder.broken.add("package")  # it may be the broken part
    return RouteTable(
        path=sources[0].path,
        files=tuple(source.path for source in sources),
        sha256=sha256(b"".join(source.data for source in sources)).hexdigest(),
        envelopes=envelopes,
        node=builder.one(root, "node", _node) or NodeSettings(),
        package=builder.one(defaults, "package", _name) if isinstance(defaults, MappingNode) else None,
        http=builder.one(root, "http", _server),
        listeners=listeners,
        endpoints=builder.each(root, "endpoints", lambda entry: _endpoint(entry, listeners)),
        routes=_with_names(builder.each(root, "routes", _case, salvage=valid_part).values()),
        routes_span=routes.key.span if routes else None,
        gateways={name: gateway for name, gateway in gateways.items() if isinstance(gateway, Gateway)},
        ignored_gateways={name: gateway for name, gateway in gateways.items() if isinstance(gateway, IgnoredGateway)},
        record=builder.one(root, "record", _record),
        foxglove=builder.one(root, "foxglove", _server),
        reload_on_change=builder.one(root, "reload", _reload) or False,
        networks=builder.one(root, "networks", _networks),
        states=builder.each(root, "state", _state),
        services={name: service for name, service in services.items() if isinstance(service, Service)},
        called={name: service for name, service in services.items() if isinstance(service, CalledService)},
        broken=frozenset(builder.broken),  # last: the others add to it
    )


def _has_gateways_only(root: MappingNode) -> bool:
    """Return whether the table receives no datagrams, so that it needs no envelope."""
    return "gateways" in root.entries and not root.entries.keys() & {"listen", "routes"}


Salvage = Callable[[Entry], Union[Entry, None]]
"""Returns the valid rest of a broken part, or None."""


def _nothing(_: Entry) -> None:
    """Return None: most parts, such as an endpoint, are valid as a whole or not at all."""


class _Builder:
    """Builds parts of the table and records which are broken."""

    def __init__(self, findings: list[Diagnostic]) -> None:
        self._findings = findings
        self.broken: set[str] = set()

    def one(self, root: MappingNode, name: str, build: Callable[[Entry], T]) -> T | None:
        """Build the part under a key of the root; None if it is absent or broken."""
        entry = root.entries.get(name)
        return self._built(name, entry, build, _nothing) if entry else None

    def each(
        self, root: MappingNode, name: str, build: Callable[[Entry], T], salvage: Salvage = _nothing
    ) -> Mapping[str, T]:
        """Build the parts under a key of the root, by name. `salvage` returns the valid rest of a broken part."""
        group = root.entries.get(name)
        if group is None:
            return {}
        if not isinstance(group.value, MappingNode):
            self.broken.add(name)
            return {}
        built = {key: self._built(f"{name}/{key}", entry, build, salvage) for key, entry in group.value.entries.items()}
        return {key: part for key, part in built.items() if part is not None}

    def _built(self, name: str, entry: Entry, build: Callable[[Entry], T], salvage: Salvage) -> T | None:
        valid: Entry | None = entry
        if not (is_valid(entry.key) and is_valid(entry.value)):
            self.broken.add(name)
            valid = salvage(entry)
        while valid:
            try:
                return build(valid)
            except InvalidValueError as error:
                self._findings.append(error.diagnostic)
                self.broken.add(name)
                marked = replace(valid, value=marked_broken(valid.value, error.diagnostic.span))
                valid = salvage(marked) if marked != valid else None
        return None


def structure(model: type[M], settings: MappingNode, **given: Any) -> M:
    """Build an object of a model class from `given` and, for all other keys of the class, from the mapping."""
    values = {
        key.attribute: _value(key, entry)
        for key in keys_of(model)
        if key.attribute not in given and (entry := _entry(settings, key.name))
    }
    return model(**given, **values)


def _entry(settings: MappingNode, name: str) -> Entry | None:
    """Return the entry of a key; dots in its name separate nested keys."""
    outer, _, inner = name.partition(".")
    entry = settings.entries.get(outer)
    return _entry(mapping(entry.value), inner) if entry and inner else entry


def _value(key: Key, entry: Entry) -> object:
    if not key.is_list:
        return _read(key, entry.value, entry.key.span)
    nodes = entry.value.items if isinstance(entry.value, SequenceNode) else (entry.value,)
    return tuple(_read(key, node, _item_span(node)) for node in nodes)


def _item_span(node: Node) -> SourceSpan:
    """Return the span of a list item; for a mapping, which has no key, that of its first key."""
    return next(iter(node.entries.values())).key.span if isinstance(node, MappingNode) and node.entries else node.span


def _read(key: Key, node: Node, span: SourceSpan) -> object:
    if read := _SYNTAX.get(key.type):
        return read(node, span)
    if isinstance(node, MappingNode):
        return structure(key.type, node, span=span)
    value = _scalar_value(key, scalar(node))
    return Located(value, node.span) if key.is_located else value


def _scalar_value(key: Key, node: ScalarNode) -> object:
    if key.quantity is not None:
        return parsed(key.quantity.parse, Located(node.value, node.span))
    if key.type is bool:
        return node.value is True
    if key.type is int:
        return whole(node)
    if key.type is Path:
        return beside(node.text, node.span)
    return key.type(node.text) if issubclass(key.type, enum.Enum) else node.text


# keys of the root


def _listener(entry: Entry) -> Listener:
    name, span, settings = entry.key.text, entry.key.span, mapping(entry.value)
    link: SerialLine | TcpClient | TcpServer
    place: Located[Address]
    if "serial" in settings.entries:
        link = structure(SerialLine, settings, span=span)
        place = Located(SerialPlace(link.serial.value, 0), link.serial.span)
    elif "connect" in settings.entries:
        link = structure(TcpClient, settings, span=span)
        place = Located(TcpPlace(*link.connect.value), link.connect.span)
    elif "accept" in settings.entries:
        link = structure(TcpServer, settings, span=span)
        place = Located(TcpPlace(*link.accept.value), link.accept.span)
    else:
        return structure(Listener, settings, name=name, span=span)
    if link.framing.kind == "hdlc" and link.checksum is not None:
        where = settings.entries["checksum"].key.span
        raise InvalidValueError(where, Code.BAD_VALUE, "HDLC frames have a CRC-32 of their own", "remove 'checksum'")
    return Listener(name, span, place, Framing.EXACT, link=link, envelope=link.envelope)


def _endpoint(entry: Entry, listeners: Mapping[str, Listener]) -> Endpoint:
    """Build an endpoint. Without `address`, it is the other end of its listener, a serial line or a TCP client."""
    name, span, settings = entry.key.text, entry.key.span, mapping(entry.value)
    beside = settings.entries.get("set")
    given = {"name": name, "span": span, "beside": _constants(beside) if beside else None}
    named = settings.get("listener")
    known = listeners.get(located(named).value) if named is not None else None
    if settings.entries.keys() & {"address", "group", "broadcast"}:
        endpoint = structure(Endpoint, settings, **given)
        _check_port(endpoint, known)
        return endpoint
    if known is not None and (known.link is None or known.accepts):
        what = f"endpoint '{name}' has no 'address'"
        hint = "write it: only the other end of a serial line or of `connect` has none"
        if known.accepts:
            hint = f"write the IP address that it connects to '{known.name}' from"
        raise InvalidValueError(span, Code.MISSING_KEY, what, hint)
    listener = located(named)
    place = known.address.value if known is not None else LinkPlace(listener.value, 0)  # which has a finding
    return structure(Endpoint, settings, **given, unicast=Located(place, listener.span))


def _check_port(endpoint: Endpoint, listener: Listener | None) -> None:
    """Check that the address has a port, unless it is that of a client of the listener."""
    address = endpoint.unicast
    if address is None:
        return
    if listener is None or not listener.accepts:
        if isinstance(address.value, TcpPlace):
            error = no_port(address.value.host)
            raise InvalidValueError(address.span, Code.BAD_ADDRESS, error.what, error.hint)
    elif not isinstance(address.value, TcpPlace):
        what = f"'{endpoint.name}' connects to '{listener.name}' from any port, but its address has one"
        raise InvalidValueError(address.span, Code.BAD_ADDRESS, what, "write only its IP address")


def _stream_framing(node: Node) -> StreamFraming:
    if isinstance(node, ScalarNode):
        return StreamFraming(node.text)
    ((kind, entry),) = mapping(node).entries.items()
    if kind == "length":
        return StreamFraming(scalar(entry.value).text)
    return StreamFraming(kind, whole(entry.value))


def _checksum(node: Node) -> Checksum:
    if isinstance(node, ScalarNode):
        return Checksum(ChecksumKind(node.text))
    ((kind, _),) = mapping(node).entries.items()
    return Checksum(ChecksumKind(kind), is_big_endian=True)


def _state(entry: Entry) -> State:
    settings = mapping(entry.value)
    topic = _topic(settings, settings.entries["topic"].key.span) if settings.get("topic") else None
    return structure(State, settings, name=entry.key.text, span=entry.key.span, topic=topic)


def _service(entry: Entry) -> Service | CalledService:
    settings = mapping(entry.value)
    if "call" in settings.entries:
        return structure(CalledService, settings, name=entry.key.text, span=entry.key.span)
    asked = settings.entries["request"]
    request = structure(ServiceRequest, mapping(asked.value), **_without_ttl(mapping(asked.value)), span=asked.key.span)
    on_timeout = _constants(settings.entries["on_timeout"])
    given = {"name": entry.key.text, "span": entry.key.span}
    return structure(Service, settings, **given, request=request, on_timeout=on_timeout)


def _envelope(entry: Entry) -> EnvelopeSettings:
    settings = mapping(entry.value)
    ours = {} if settings.get("protos") else {"protos": Located(_own_protos(entry.key.span), entry.key.span)}
    return structure(EnvelopeSettings, settings, name="", **ours)


def _named_envelope(entry: Entry) -> EnvelopeSettings:
    return replace(_envelope(entry), name=entry.key.text)


def _own_protos(span: SourceSpan) -> Path:
    try:
        return asset("protos")
    except FileNotFoundError as error:
        what = "'envelope' has no 'protos', and this installation includes none"
        raise InvalidValueError(span, Code.MISSING_KEY, what, "add `protos: FOLDER`") from error


def _node(entry: Entry) -> NodeSettings:
    settings = mapping(entry.value)
    diagnostics = settings.entries["diagnostics"].key.span if boolean(settings, "diagnostics") else None
    return structure(NodeSettings, settings, span=entry.key.span, diagnostics=diagnostics)


def _server(entry: Entry) -> ServerSettings:
    return structure(ServerSettings, mapping(entry.value), span=entry.key.span)


def _name(entry: Entry) -> Located[str]:
    return located(entry.value)


def _record(entry: Entry) -> RecordSettings:
    return structure(RecordSettings, mapping(entry.value), span=entry.key.span)


def _reload(entry: Entry) -> bool:
    return boolean(mapping(entry.value), "on_change")


def _networks(entry: Entry) -> Networks:
    return Networks(entry.key.span, tuple(map(_network, sequence(entry.value).items)))


def _network(node: Node) -> IPNetwork:
    written = located(node)
    try:
        network = ip_network(written.value, strict=False)
    except ValueError as error:  # IPv6: the schema has checked the form of IPv4 networks
        what = f"'{written.value}' is not a network"
        raise InvalidValueError(written.span, Code.BAD_VALUE, what, "write one such as fd00::/8") from error
    try:
        return ip_network(written.value)
    except ValueError as error:
        what = f"{written.value} is the address of a host, not of a network"
        raise InvalidValueError(written.span, Code.BAD_VALUE, what, f"write {network}") from error


# routes


def _case(entry: Entry) -> tuple[Route, ...]:
    """Build the routes of one payload case, all named after the case for now."""
    if not isinstance(entry.value, SequenceNode):
        return (_route(entry.key, entry.value, entry.key.span),)
    return tuple(_route(entry.key, item, _item_span(item)) for item in entry.value.items)


def _route(case: ScalarNode, node: Node, span: SourceSpan) -> Route:
    settings = mapping(node)
    sources = _members(settings.get("source"))
    route = structure(
        Route,
        settings,
        **_without_ttl(settings),
        name=case.text,
        span=span,
        case=Located(case.text, case.span),
        sources=tuple(located(source) for source in sources if isinstance(source, ScalarNode)),
        source_topics=tuple(
            _topic(source, _item_span(source)) for source in sources if isinstance(source, MappingNode)
        ),
        deadman=None,
    )
    entry = settings.entries.get("deadman")
    if entry is None:
        return route
    if reason := optional_text(mapping(entry.value), "none"):
        return replace(route, no_deadman=reason.value)
    return replace(route, deadman=_deadman(entry, tuple(to.endpoint for to in route.destinations)))


def _without_ttl(settings: MappingNode) -> Mapping[str, str | None]:
    """Return the values of a model for `ttl: {none: why}`; none if `ttl` is a duration or missing."""
    ttl = settings.get("ttl")
    return {"ttl": None, "no_ttl": located(ttl.get("none")).value} if isinstance(ttl, MappingNode) else {}


def _members(node: Node | None) -> Sequence[Node]:
    """Return the items of a list, or a single value as the only item."""
    return node.items if isinstance(node, SequenceNode) else (node,) if node else ()


def _with_names(cases: Iterable[tuple[Route, ...]]) -> tuple[Route, ...]:
    """Return the routes of all cases, with unique names for metrics and log.

    The only route of a case keeps the case's name; several routes are named after their first source.
    """
    cases = tuple(cases)
    taken = {route.name for routes in cases for route in routes}
    named: list[Route] = []
    for routes in cases:
        for route in routes:
            name = (
                route.name
                if len(routes) == 1
                else _free(f"{route.name}_from_{route.sources[0].value if route.sources else ROS}", taken)
            )
            taken.add(name)
            named.append(replace(route, name=name))
    return tuple(named)


def _free(name: str, taken: set[str]) -> str:
    """Return the name, with the first suffix `_2`, `_3`, ... that makes it unique if it is taken."""
    free, number = name, 1
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def _destination(node: Node, span: SourceSpan) -> Destination:
    if isinstance(node, ScalarNode):
        return Destination(located(node), node.span)
    return structure(Destination, mapping(node), span=span)


def _topic(node: Node, span: SourceSpan) -> Topic:
    return structure(Topic, mapping(node), span=span)


def _deadman(entry: Entry, destinations: tuple[Located[str], ...]) -> Deadman:
    """Build the deadman of a route. Without `to`, its payloads go to the route's destinations."""
    settings = _with_timeout(entry)
    payloads = tuple(
        Payload(located(payload.key), _constants(payload)) for payload in mapping(settings.get("send")).entries.values()
    )
    own = {} if settings.get("to") else {"to": destinations}
    return structure(Deadman, settings, span=entry.key.span, payloads=payloads, **own)


def _obeyed(node: Node, span: SourceSpan) -> Obeyed:
    """Build `obeyed`: one payload case with its condition, and `within`."""
    settings = mapping(node)
    [shown] = [entry for name, entry in settings.entries.items() if name != "within"]
    when = _expression(shown.value, shown.key.span)
    return structure(Obeyed, settings, span=span, case=located(shown.key), when=when)


def _with_timeout(deadman: Entry) -> MappingNode:
    """Return the settings of a deadman. Raises InvalidValueError if neither they nor the defaults have a timeout."""
    settings = mapping(deadman.value)
    if settings.get("timeout") is None:
        hint = "set it here, or for all deadman timers with `defaults: {deadman: {timeout: 500ms}}`"
        what = "'deadman' lacks the key 'timeout'"
        raise InvalidValueError(deadman.key.span, Code.MISSING_KEY, what, hint)
    return settings


def _choices(node: MappingNode, span: SourceSpan) -> Expression:
    values = tuple(
        (located(entry.key), _expression(entry.value, entry.key.span))
        for name, entry in node.entries.items()
        if name not in (MAP, ELSE)
    )
    otherwise = node.entries.get(ELSE)
    chosen = Choices(
        _expression(node.entries[MAP].value, span),
        values,
        _expression(otherwise.value, otherwise.key.span) if otherwise else None,
    )
    return Expression("", TextSpan(node.entries[MAP].key.span), choices=chosen)


def _expression(node: Node, span: SourceSpan) -> Expression:
    """Build an expression: a scalar as written, a list, a choice, literal text, or the fields of a list's element."""
    if is_choice(node):
        return _choices(mapping(node), span)
    if is_text(node):
        return replace(_expression(mapping(node).entries[TEXT].value, span), literal=True)
    if isinstance(node, MappingNode):
        return Expression("", TextSpan(node.span), fields=_listed_fields(node, node.span))
    if isinstance(node, SequenceNode):
        return Expression("", TextSpan(node.span), tuple(_expression(item, item.span) for item in node.items))
    written = scalar(node)
    return Expression(written.text, written.text_span)


def _fields(node: Node, span: SourceSpan) -> FieldMap:
    """Build a field map from `auto`, or from a mapping of fields that may contain `auto`."""
    if isinstance(node, ScalarNode):
        return FieldMap(node.span, auto=True, entries=())
    written = mapping(node)
    own = replace(written, entries={key: entry for key, entry in written.entries.items() if key != AUTO})
    return FieldMap(span, auto=boolean(written, AUTO), entries=tuple(_field_entries(own, (), ())))


def _constants(entry: Entry) -> FieldMap:
    return _listed_fields(mapping(entry.value), entry.key.span)


def _listed_fields(node: MappingNode, span: SourceSpan) -> FieldMap:
    """Build the fields of a constant payload or a list's element; here `auto` is an ordinary field."""
    return FieldMap(span, auto=False, entries=tuple(_field_entries(node, (), ())))


def _field_entries(fields: MappingNode, path: tuple[str, ...], spans: tuple[SourceSpan, ...]) -> Iterator[FieldEntry]:
    for name, entry in fields.entries.items():
        inner = (*path, *name.split("."))
        inner_spans = (*spans, *_part_spans(entry.key))
        if is_elements(entry.value):
            yield FieldEntry(inner, inner_spans, _elements(mapping(entry.value)))
        elif isinstance(entry.value, MappingNode) and not is_choice(entry.value) and not is_text(entry.value):
            yield from _field_entries(entry.value, inner, inner_spans)
        else:
            yield FieldEntry(inner, inner_spans, _expression(entry.value, entry.key.span))


def _elements(node: MappingNode) -> Elements:
    source, fields = node.entries[EACH], node.entries[FIELDS]
    return Elements(_expression(source.value, source.key.span), _fields(fields.value, fields.key.span))


def _part_spans(key: ScalarNode) -> Iterator[SourceSpan]:
    """Yield the spans of the names between the dots of a key; the whole key if its text is not verbatim."""
    start = 0
    for part in key.text.split("."):
        yield key.text_span.part(start, start + len(part))
        start += len(part) + 1


# gateways


def _gateway(entry: Entry) -> Gateway | IgnoredGateway:
    name, span, settings = entry.key.text, entry.key.span, mapping(entry.value)
    if settings.get("ignore"):
        return structure(IgnoredGateway, settings, name=name, span=span)
    ((kind, chosen),) = mapping(settings.get("transport")).entries.items()
    transport = Transport(kind)
    format_ = optional_text(settings, "format")
    return structure(
        Gateway,
        settings,
        name=name,
        span=span,
        transport=Located(transport, chosen.key.span),
        address=None if transport is Transport.ZENOH else _transport_address(transport, located(chosen.value)),
        zenoh=structure(ZenohSettings, mapping(chosen.value)) if transport is Transport.ZENOH else None,
        format=GatewayFormat(format_.value) if format_ else DEFAULT_FORMATS[transport],
        rates=tuple(_rates(settings.get("rates"))),
        **_from_clients(settings.get("inbound")),
    )


def _from_clients(inbound: Node | None) -> dict[str, tuple[object, ...]]:
    """Return the topics and the services in `inbound`, as attributes of a gateway."""
    topics: list[Inbound] = []
    services: list[InboundService] = []
    for node in _members(inbound):
        settings, span = mapping(node), _item_span(node)
        if "service" in settings.entries:
            services.append(structure(InboundService, settings, **_without_ttl(settings), span=span))
        else:
            topics.append(_inbound(settings, span))
    return {"inbound": tuple(topics), "calls": tuple(services)}


def _transport_address(transport: Transport, written: Located[str]) -> Located[Address]:
    kind = REMOTE if transport is Transport.UDP else LOCAL
    return Located(parsed(kind.parse, written), written.span)


def _zenoh_config(node: Node, span: SourceSpan) -> ZenohConfig:
    """Build a Zenoh configuration from a mapping of settings, or from the path of a file."""
    if isinstance(node, MappingNode):
        return ZenohConfig(span, json.dumps(to_data(node)), spans=dict(_spans(node)))
    written = located(node)
    path = beside(written.value, written.span)
    try:
        if inputs.exists(path) and not inputs.is_file(path):
            raise OSError(0, "it is not a regular file")
        return ZenohConfig(written.span, inputs.read_text(path), path)
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or "").lower() if isinstance(error, OSError) else "it is not UTF-8"
        what = f"'{written.value}' cannot be read: {why}"
        remedy = f"correct the path: it leads to {shown_path(path)}"
        hint = remedy if isinstance(error, FileNotFoundError) else ""
        raise InvalidValueError(written.span, Code.BAD_FILE, what, hint) from error


def _spans(node: Node, here: Steps = ()) -> Iterator[tuple[Steps, SourceSpan]]:
    """Yield the span of each key and of each list item, by path."""
    if isinstance(node, MappingNode):
        for key, entry in node.entries.items():
            yield (*here, key), entry.key.span
            yield from _spans(entry.value, (*here, key))
    elif isinstance(node, SequenceNode):
        for index, item in enumerate(node.items):
            yield (*here, index), item.span
            yield from _spans(item, (*here, index))


def _pattern(node: Node, _: SourceSpan) -> TopicPattern:
    is_regex = isinstance(node, MappingNode)
    written = located(node.get("regex") if isinstance(node, MappingNode) else node)
    return TopicPattern(written.value, is_regex, written.span)


def _rates(node: Node | None) -> Iterator[TopicRate]:
    for entry in mapping(node).entries.values() if node else ():
        rate = scalar(entry.value)
        pattern = TopicPattern(entry.key.text, is_regex=False, span=entry.key.span)
        yield TopicRate(pattern, parsed(TOPIC_RATE.parse, Located(rate.value, rate.span)))


def _inbound(settings: MappingNode, span: SourceSpan) -> Inbound:
    entry = settings.entries.get("deadman")
    deadman = _inbound_deadman(entry) if entry else None
    topic = _topic(settings, span)
    return structure(Inbound, settings, **_without_ttl(settings), span=span, topic=topic, deadman=deadman)


def _inbound_deadman(entry: Entry) -> InboundDeadman:
    settings = _with_timeout(entry)
    return structure(InboundDeadman, settings, span=entry.key.span, fields=_constants(settings.entries["send"]))


_SYNTAX: Mapping[object, Callable[[Node, SourceSpan], object]] = {
    Checksum: lambda node, _: _checksum(node),
    Destination: _destination,
    Expression: _expression,
    FieldMap: _fields,
    IPNetwork: lambda node, _: _network(node),
    Obeyed: _obeyed,
    StreamFraming: lambda node, _: _stream_framing(node),
    Topic: _topic,
    TopicPattern: _pattern,
    ZenohConfig: _zenoh_config,
}
"""Readers of types with their own syntax. Each takes the value's node and the span of its key."""

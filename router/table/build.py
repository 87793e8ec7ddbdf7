"""Nodes that have their shape to the typed route table; what has a finding is left out and named in `broken`.

Knows the schema's shape and relies on it. Routes are built in `build_routes`, gateways in `build_gateways`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from ipaddress import IPv4Network
from typing import TypeVar, Union

from router.assets import asset
from router.errors import Code, Diagnostic
from router.table.build_addresses import local_address, remote_address
from router.table.build_gateways import build_gateway
from router.table.build_routes import build_case, named
from router.table.model import (
    DEFAULT_STALE_AFTER,
    Address,
    Endpoint,
    EndpointKind,
    EnvelopeSettings,
    Framing,
    Gateway,
    IgnoredGateway,
    Listener,
    Located,
    Networks,
    NodeSettings,
    RecordSettings,
    RouteTable,
)
from router.table.nodes import Entry, MappingNode, Node, SequenceNode, is_sound, marked_broken
from router.table.reading import (
    UnsoundError,
    beside,
    boolean,
    duration,
    integer,
    located,
    mapping,
    optional_text,
    text,
    text_or,
)
from router.table.salvage import sound_part
from router.table.source import Source
from router.table.units import (
    parse_coalesce,
    parse_data_rate,
    parse_disk_size,
    parse_duration,
    parse_patience,
    parse_size,
)

T = TypeVar("T")

DEFAULT_NODE = NodeSettings("rover_router", "/")
DEFAULT_RECEIVE_BUFFER = 4 << 20
DEFAULT_COALESCE = 1_000_000
DEFAULT_MAX_SIZE = 256 << 20
DEFAULT_MAX_AGE = 600_000_000_000
DEFAULT_KEEP = 4 << 30


def build_table(root: MappingNode, sources: Sequence[Source], findings: list[Diagnostic]) -> RouteTable | None:
    """The table of everything sound; None where the envelope or the routes as a whole are not, or are missing.

    What only the values themselves can tell, such as a size beyond what the kernel takes, is added to
    `findings`.
    """
    builder = _Builder(findings)
    envelope = builder.one(root, "envelope", _envelope)
    routes = root.entries.get("routes")
    endpoints = root.entries.get("endpoints")
    if not all(entry is None or _is_group(entry) for entry in (routes, endpoints)):
        return None
    if (envelope is None or routes is None) and not _has_gateways_only(root):
        return None
    gateways = builder.each(root, "gateways", build_gateway, salvage=sound_part)
    return RouteTable(
        path=sources[0].path,
        files=tuple(source.path for source in sources),
        sha256=hashlib.sha256(b"".join(source.data for source in sources)).hexdigest(),
        envelope=envelope,
        node=builder.one(root, "node", _node) or DEFAULT_NODE,
        metrics=builder.one(root, "metrics", _address),
        listeners=builder.each(root, "listen", _listener),
        endpoints=builder.each(root, "endpoints", _endpoint),
        routes=named(builder.each(root, "routes", build_case, salvage=sound_part).values()),
        routes_span=routes.key.span if routes else None,
        gateways={name: each for name, each in gateways.items() if isinstance(each, Gateway)},
        ignored_gateways={name: each for name, each in gateways.items() if isinstance(each, IgnoredGateway)},
        broken=frozenset(builder.broken),
        record=builder.one(root, "record", _record),
        foxglove=builder.one(root, "foxglove", _address),
        reload_on_change=builder.one(root, "reload", _reload) or False,
        networks=builder.one(root, "networks", _networks),
    )


Salvage = Callable[[Entry], Union[Entry, None]]
"""What is sound in a part that is broken, if anything is."""


def _nothing(_: Entry) -> None:
    """Most parts are all or nothing: an endpoint without its address is none."""


class _Builder:
    """Builds parts and remembers which could not be built."""

    def __init__(self, findings: list[Diagnostic]) -> None:
        self._findings = findings
        self.broken: set[str] = set()

    def one(self, root: MappingNode, name: str, build: Callable[[Entry], T]) -> T | None:
        """The part under a key of the root; None when it is absent or broken."""
        entry = root.entries.get(name)
        return self._built(name, entry, build) if entry else None

    def each(
        self,
        root: MappingNode,
        name: str,
        build: Callable[[Entry], T],
        salvage: Salvage = _nothing,
    ) -> Mapping[str, T]:
        """The parts by name under a key of the root, of a broken one what `salvage` leaves."""
        group = root.entries.get(name)
        if group is None:
            return {}
        if not isinstance(group.value, MappingNode):
            self.broken.add(name)
            return {}
        built = {key: self._built(f"{name}/{key}", entry, build, salvage) for key, entry in group.value.entries.items()}
        return {key: part for key, part in built.items() if part is not None}

    def _built(
        self,
        name: str,
        entry: Entry,
        build: Callable[[Entry], T],
        salvage: Salvage = _nothing,
    ) -> T | None:
        sound: Entry | None = entry
        if not (is_sound(entry.key) and is_sound(entry.value)):
            self.broken.add(name)
            sound = salvage(entry)
        while sound:
            try:
                return build(sound)
            except UnsoundError as error:
                self._findings.append(error.diagnostic)
                self.broken.add(name)
                marked = replace(sound, value=marked_broken(sound.value, error.diagnostic.span))
                sound = salvage(marked) if marked != sound else None
        return None


def _has_gateways_only(root: MappingNode) -> bool:
    """The table receives no datagrams, so it needs no envelope."""
    return "gateways" in root.entries and not root.entries.keys() & {"listen", "routes"}


def _is_group(entry: Entry) -> bool:
    return isinstance(entry.value, MappingNode)


def _envelope(entry: Entry) -> EnvelopeSettings:
    settings = mapping(entry.value)
    protos, lock = optional_text(settings, "protos"), optional_text(settings, "lock")
    return EnvelopeSettings(
        beside(protos) if protos else Located(asset("protos"), entry.key.span),
        text(settings, "message"),
        text(settings, "oneof"),
        beside(lock) if lock else None,
    )


def _node(entry: Entry) -> NodeSettings:
    settings = mapping(entry.value)
    return NodeSettings(
        text_or(settings, "name", DEFAULT_NODE.name),
        text_or(settings, "namespace", DEFAULT_NODE.namespace),
        settings.entries["diagnostics"].key.span if boolean(settings, "diagnostics") else None,
        entry.key.span,
    )


def _address(entry: Entry) -> Located[Address]:
    return local_address(text(mapping(entry.value), "address"))


def _record(entry: Entry) -> RecordSettings:
    settings = mapping(entry.value)
    directory, last = beside(text(settings, "directory")), duration(settings, "last")
    return RecordSettings(
        span=entry.key.span,
        directory=directory.value,
        continuous=settings.get("continuous") is None or boolean(settings, "continuous"),
        last=last.value if last else None,
        max_size=_parsed(settings, "max_size", parse_disk_size, DEFAULT_MAX_SIZE),
        max_age=_parsed(settings, "max_age", parse_duration, DEFAULT_MAX_AGE),
        keep=_parsed(settings, "keep", parse_disk_size, DEFAULT_KEEP),
    )


def _networks(entry: Entry) -> Networks:
    if not isinstance(entry.value, SequenceNode):
        raise TypeError(f"a sequence, not {entry.value!r}")
    return Networks(entry.key.span, tuple(map(_network, entry.value.items)))


def _network(node: Node) -> IPv4Network:
    written = located(node)
    try:
        return IPv4Network(written.value)
    except ValueError as error:  # not its form, which the schema has checked
        what = f"{written.value} is a host of the network {IPv4Network(written.value, strict=False)}"
        raise UnsoundError(Diagnostic(written.span, Code.BAD_VALUE, what, "write the network")) from error


def _reload(entry: Entry) -> bool:
    return boolean(mapping(entry.value), "on_change")


def _parsed(settings: MappingNode, key: str, parse: Callable[[str], T], default: T) -> T:
    written = optional_text(settings, key)
    return UnsoundError.guard(parse, written) if written else default


def _listener(entry: Entry) -> Listener:
    settings = mapping(entry.value)
    return Listener(
        name=entry.key.text,
        span=entry.key.span,
        address=local_address(text(settings, "address")),
        framing=Framing(text_or(settings, "framing", Framing.ZERO_TRIMMED.value)),
        receive_buffer=_parsed(settings, "receive_buffer", parse_size, DEFAULT_RECEIVE_BUFFER),
        coalesce=_parsed(settings, "coalesce", parse_coalesce, DEFAULT_COALESCE),
        interface=optional_text(settings, "interface"),
    )


def _endpoint(entry: Entry) -> Endpoint:
    settings = mapping(entry.value)
    budget = optional_text(settings, "budget")
    return Endpoint(
        name=entry.key.text,
        span=entry.key.span,
        address=remote_address(text(settings, "address")),
        kind=EndpointKind(text(settings, "kind").value),
        source_port=integer(settings, "source_port"),
        trim_trailing_zeros=boolean(settings, "trim_trailing_zeros"),
        budget=Located(UnsoundError.guard(parse_data_rate, budget), budget.span) if budget else None,
        stale_after=_parsed(settings, "stale_after", parse_patience, DEFAULT_STALE_AFTER) or None,
        listener=optional_text(settings, "listener"),
    )

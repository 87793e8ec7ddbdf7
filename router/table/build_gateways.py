"""Gateways: nodes that have their shape to Gateway, with what is left out at its default.

Knows the schema's shape; which topics and types exist is the compiler's business.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping

from router.errors import Code, Diagnostic, SourceSpan, shown_path
from router.table.build_addresses import local_address, remote_address
from router.table.build_fields import constants
from router.table.build_routes import DEFAULT_REPEAT, sends_at_start
from router.table.build_targets import item_span, topic
from router.table.model import (
    Address,
    Gateway,
    GatewayFormat,
    IgnoredGateway,
    Inbound,
    InboundDeadman,
    Located,
    TopicPattern,
    TopicRate,
    Transport,
    ZenohConfig,
    ZenohSettings,
)
from router.table.nodes import Entry, MappingNode, Node, SequenceNode, to_data
from router.table.nodes import Path as Steps
from router.table.reading import (
    UnsoundError,
    beside,
    duration,
    integer,
    items,
    located,
    mapping,
    needed_duration,
    number_or_text,
    text,
    text_or,
)
from router.table.units import (
    parse_datagram_size,
    parse_interval,
    parse_message_size,
    parse_period,
    parse_topic_rate,
)

DEFAULT_FORMATS: Mapping[Transport, GatewayFormat] = {
    Transport.UDP: GatewayFormat.GATEWAY_V1,
    Transport.TCP: GatewayFormat.GATEWAY_V1,
    Transport.WEBSOCKET: GatewayFormat.JSON,
    Transport.ZENOH: GatewayFormat.GATEWAY_V1,
}
DEFAULT_PUBLISH_PERIOD = 500_000_000
DEFAULT_INTERVAL = 5_000_000_000
"""ns, between schemas and between looks at the ROS graph."""
DEFAULT_MODE = "peer"
DEFAULT_MAX_DATAGRAM = 1400
DEFAULT_MAX_MESSAGE = 16 << 20
DEFAULT_MAX_CLIENTS = 1024
DEFAULT_MAX_CLIENTS_PER_HOST = 16


def build_gateway(entry: Entry) -> Gateway | IgnoredGateway:
    settings = mapping(entry.value)
    if settings.get("ignore"):
        return IgnoredGateway(entry.key.text, entry.key.span, text(settings, "ignore").value)
    ((name, chosen),) = mapping(settings.get("transport")).entries.items()
    transport = Transport(name)
    topics = settings.get("topics")
    patterns = mapping(topics) if topics else None
    max_clients = integer(settings, "max_clients")
    max_per_host = integer(settings, "max_clients_per_host")
    return Gateway(
        name=entry.key.text,
        span=entry.key.span,
        transport=Located(transport, chosen.key.span),
        address=_address(transport, chosen.value),
        zenoh=_zenoh(mapping(chosen.value)) if transport is Transport.ZENOH else None,
        receive=local_address(text(settings, "receive")) if settings.get("receive") else None,
        format=GatewayFormat(text_or(settings, "format", DEFAULT_FORMATS[transport].value)),
        include=_patterns(patterns, "include"),
        exclude=_patterns(patterns, "exclude"),
        publish_period=_parsed(settings, "publish_period", parse_period, DEFAULT_PUBLISH_PERIOD),
        schema_period=_parsed(settings, "schema_period", parse_interval, DEFAULT_INTERVAL),
        discovery_period=_parsed(settings, "discovery_period", parse_interval, DEFAULT_INTERVAL),
        compression=_compression(settings),
        rates=_rates(settings),
        max_datagram=_parsed(settings, "max_datagram", parse_datagram_size, DEFAULT_MAX_DATAGRAM),
        max_message=_parsed(settings, "max_message", parse_message_size, DEFAULT_MAX_MESSAGE),
        max_clients=max_clients.value if max_clients else DEFAULT_MAX_CLIENTS,
        max_clients_per_host=max_per_host.value if max_per_host else DEFAULT_MAX_CLIENTS_PER_HOST,
        inbound=tuple(map(_inbound, items(settings, "inbound"))),
    )


def _parsed(settings: MappingNode, key: str, parse: Callable[[str], int], default: int) -> int:
    return UnsoundError.guard(parse, text(settings, key)) if settings.get(key) else default


def _address(transport: Transport, node: Node) -> Located[Address] | None:
    if transport is Transport.ZENOH:
        return None
    return (remote_address if transport is Transport.UDP else local_address)(located(node))


def _zenoh(settings: MappingNode) -> ZenohSettings:
    return ZenohSettings(
        key=text(settings, "key"),
        mode=text_or(settings, "mode", DEFAULT_MODE),
        connect=tuple(located(node).value for node in items(settings, "connect")),
        listen=tuple(located(node).value for node in items(settings, "listen")),
        config=_zenoh_config(settings.entries["config"]) if "config" in settings.entries else None,
    )


def _zenoh_config(entry: Entry) -> ZenohConfig:
    if isinstance(entry.value, MappingNode):
        return ZenohConfig(entry.key.span, json.dumps(to_data(entry.value)), places=dict(_places(entry.value)))
    written = located(entry.value)
    path = beside(written).value
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "it is no ordinary file")
        return ZenohConfig(written.span, path.read_text(encoding="utf-8"), path)
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or "").lower() if isinstance(error, OSError) else "it is not UTF-8"
        what = f"'{written.value}' cannot be read: {why}"
        hint = f"looked for {shown_path(path)}" if isinstance(error, FileNotFoundError) else ""
        raise UnsoundError(Diagnostic(written.span, Code.BAD_FILE, what, hint)) from error


def _places(node: Node, here: Steps = ()) -> Iterator[tuple[Steps, SourceSpan]]:
    """Of each key, and of each item of a list, by its path."""
    if isinstance(node, MappingNode):
        for key, entry in node.entries.items():
            yield (*here, key), entry.key.span
            yield from _places(entry.value, (*here, key))
    elif isinstance(node, SequenceNode):
        for index, item in enumerate(node.items):
            yield (*here, index), item.span
            yield from _places(item, (*here, index))


def _patterns(settings: MappingNode | None, key: str) -> tuple[TopicPattern, ...]:
    return tuple(map(_pattern, items(settings, key))) if settings else ()


def _pattern(node: Node) -> TopicPattern:
    is_regex = isinstance(node, MappingNode)
    written = text(node, "regex") if isinstance(node, MappingNode) else located(node)
    return TopicPattern(written.value, is_regex, written.span)


def _compression(settings: MappingNode) -> int:
    chosen = settings.get("compression")
    level = integer(mapping(chosen), "zstd") if chosen else None
    return level.value if level else 0


def _rates(settings: MappingNode) -> tuple[TopicRate, ...]:
    rates = settings.get("rates")
    return tuple(map(_rate, mapping(rates).entries.values())) if rates else ()


def _rate(entry: Entry) -> TopicRate:
    pattern = TopicPattern(entry.key.text, is_regex=False, span=entry.key.span)
    return TopicRate(pattern, UnsoundError.guard(parse_topic_rate, number_or_text(entry.value)))


def _inbound(node: Node) -> Inbound:
    settings = mapping(node)
    published = topic(node)
    deadman = settings.entries.get("deadman")
    return Inbound(
        topic=published,
        span=item_span(settings),
        ttl=duration(settings, "ttl"),
        max_rate=published.max_rate,
        deadman=_deadman(deadman) if deadman else None,
    )


def _deadman(entry: Entry) -> InboundDeadman:
    settings = mapping(entry.value)
    return InboundDeadman(
        span=entry.key.span,
        timeout=needed_duration(settings, "timeout"),
        fields=constants(settings.entries["send"]),
        repeat=duration(settings, "repeat") or Located(DEFAULT_REPEAT, entry.key.span),
        at_start=sends_at_start(settings),
    )

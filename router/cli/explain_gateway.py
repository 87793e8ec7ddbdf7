"""What `router explain` says of a gateway: what it sends how often, which topics that comes to, what it lets in.

Prints what the compiler found out, and what ROS knows of topics; finds out nothing itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from time import sleep

from router.cli.explain_words import at_start, quality
from router.compiler.checked import CheckedGateway, CheckedInbound
from router.compiler.selection import TopicSelector
from router.compiler.topics import resolved
from router.errors import StartError, shown_path
from router.gateway.following import by_frequency
from router.ros.environment import check_environment, ros_remedy
from router.table.model import (
    EACH,
    Gateway,
    GatewayFormat,
    IgnoredGateway,
    RouteTable,
    TopicPattern,
    Transport,
    ZenohSettings,
)
from router.table.quantities import duration

Topics = Mapping[str, str]
"""What is known of topics, by absolute name: types, and how many publish them where somebody looked."""


def known_topics(table: RouteTable) -> Topics:
    """What routes and gateways of the table publish or subscribe to."""
    topics = [topic for route in table.routes for topic in route.topics]
    topics += [inbound.topic for gateway in table.gateways.values() for inbound in gateway.inbound]
    return {resolved(topic.topic.value, table.node): topic.type.value for topic in topics}


def seen_topics(table: RouteTable, seconds: float) -> Topics:
    """The same with all that a node has discovered after so long. Raises StartError."""
    check_environment(os.environ)
    try:
        from router.ros.node import close_node, open_node
        from router.ros.topics import RosTopics
    except ImportError as error:
        raise StartError(f"--live needs ROS 2, which is not installed here ({error}); {ros_remedy()}") from error
    node = open_node("router_explain")
    try:
        sleep(seconds)
        topics = RosTopics(node)
        seen = {name: [publisher.type_name for publisher in topics.publishers(name)] for name in topics.names()}
    finally:
        close_node(node)
    known = {name: f"{type_name}, no publisher" for name, type_name in known_topics(table).items()}
    return known | {name: _publishers(types) for name, types in seen.items() if types}


def _publishers(types: Iterable[str]) -> str:
    """That which gateways choose first."""
    return ", ".join(f"{name} of {times}" for name, times in by_frequency(types).items())


def explained_gateway(checked: CheckedGateway, topics: Topics) -> Iterator[str]:
    gateway = checked.settings
    yield f"{gateway.name}: gateway, {_transport(gateway)}, {gateway.format.value}  ({gateway.span})"
    yield f"  {_period(gateway.publish_period)}; {_regularly(gateway)}"
    yield f"  messages of up to {gateway.max_message} bytes{_sizes(gateway)}"
    yield from _patterns(gateway)
    yield from _matched(TopicSelector(gateway, [entry.topic for entry in checked.inbound]), topics)
    for entry in checked.inbound:
        yield ""
        yield from _inbound(entry)


def ignored_gateway(gateway: IgnoredGateway) -> Iterator[str]:
    yield f"{gateway.name}: gateway  ({gateway.span})"
    yield f"  ignored: {gateway.reason}"


def _transport(gateway: Gateway) -> str:
    if gateway.zenoh is not None:
        places = [f"connects to {', '.join(gateway.zenoh.connect)}"] if gateway.zenoh.connect else []
        places += [f"listens on {', '.join(gateway.zenoh.listen)}"] if gateway.zenoh.listen else []
        places += _configured(gateway.zenoh)
        return ", ".join([f"zenoh {gateway.zenoh.mode} under {gateway.zenoh.key.value}", *places])
    assert gateway.address is not None  # noqa: S101 - only Zenoh has none
    if gateway.transport.value is not Transport.UDP:
        most = f"{gateway.max_clients} clients at most, {gateway.max_clients_per_host} from one host"
        return f"{gateway.transport.value.value} on {gateway.address.value}, {most}"
    heard = f"on {gateway.receive.value}" if gateway.receive else "from any port"
    return f"udp to {gateway.address.value} {heard}"


def _configured(zenoh: ZenohSettings) -> list[str]:
    """By what: never the values, of which some are secret."""
    if zenoh.config is None:
        return []
    if zenoh.config.path is not None:
        return [f"configured by {shown_path(zenoh.config.path)}"]
    return [f"configures {' and '.join(str(path[0]) for path in zenoh.config.places if len(path) == 1)}"]


def _period(period: int) -> str:
    return "every message" if period == EACH else f"the latest value every {duration(period)}"


def _regularly(gateway: Gateway) -> str:
    again = f"schemas again every {duration(gateway.schema_period)}, "
    connected = gateway.transport.value in (Transport.TCP, Transport.WEBSOCKET)
    return f"{'' if connected else again}looks for topics every {duration(gateway.discovery_period)}"


def _sizes(gateway: Gateway) -> str:
    compressed = f", compressed with zstd {gateway.compression}" if gateway.compression else ""
    datagrams = f", in datagrams of up to {gateway.max_datagram} bytes"
    return compressed + (datagrams if gateway.format is GatewayFormat.GATEWAY_V2 else "")


def _patterns(gateway: Gateway) -> Iterator[str]:
    include = ", ".join(map(_pattern, gateway.include)) or "every topic that is not hidden"
    exclude = f", but not {', '.join(map(_pattern, gateway.exclude))}" if gateway.exclude else ""
    yield f"  sends {include}{exclude}"
    for rate in gateway.rates:
        yield f"    {_pattern(rate.pattern)}: {_period(rate.period)}"


def _pattern(pattern: TopicPattern) -> str:
    return f"regex {pattern.text}" if pattern.is_regex else pattern.text


def _matched(selector: TopicSelector, topics: Topics) -> Iterator[str]:
    rows = []
    for name in sorted(topics):
        if chosen := selector.chosen_by(name):
            rated = selector.rated_by(name)
            why = _pattern(chosen) + (f", rate of {_pattern(rated)}" if rated else "")
            rows.append((name, topics[name], _period(selector.period(name)), why))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        name, types, period, why = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield f"  ~ {name}  {types}  {period}  by {why}".rstrip()


def _inbound(entry: CheckedInbound) -> Iterator[str]:
    inbound = entry.inbound
    yield f"  from clients {entry.topic}: {entry.type}  ({inbound.span})"
    yield quality(inbound.topic)
    if inbound.ttl is not None:
        yield f"    dropped when older than {duration(inbound.ttl.value)}"
    if inbound.max_rate is not None:
        yield f"    at most {inbound.max_rate.value:g} Hz"
    if inbound.deadman is not None and entry.stop is not None:
        timeout, repeat = duration(inbound.deadman.timeout.value), duration(inbound.deadman.repeat.value)
        start = at_start(inbound.deadman.at_start)
        yield f"    deadman: {_constants(entry)} when no message came for {timeout}, again every {repeat}, {start}"


def _constants(entry: CheckedInbound) -> str:
    assert entry.inbound.deadman is not None  # noqa: S101 - the caller's choice
    entries = entry.inbound.deadman.fields.entries
    return ", ".join(f"{'.'.join(each.path)} {each.value.text}" for each in entries) or "all fields at their defaults"

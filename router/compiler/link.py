"""Assemble the program: handlers, what must be opened for them, and the counters with every series.

Expects a table without errors: nothing here is checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from router.compiler.checked import CheckedDeadman, CheckedGateway, CheckedInbound, CheckedRoute
from router.compiler.handlers import HandlerSource
from router.compiler.lookup import layout
from router.compiler.metrics import (
    CLIENT_DROP_REASONS,
    CLIENTS,
    GATEWAY_DROP_REASONS,
    GATEWAY_REJECT_REASONS,
    INBOUND_DROP_REASONS,
    QOS_POLICIES,
    RECORD_DROP_REASONS,
    REJECT_REASONS,
    RELOAD_RESULTS,
    TOPIC_STATES,
    UNKNOWN_CASE,
    Counters,
)
from router.compiler.namespace import NAMESPACE
from router.compiler.program import (
    STRANGER,
    DeadmanPlan,
    GatewayPlan,
    Handler,
    InboundPlan,
    Program,
    TopicPlan,
    source_label,
)
from router.compiler.topics import qos_of
from router.table.model import ANY, ROS, Deadman, Gateway, InboundDeadman, RouteTable, Topic
from router.types.model import MessageType
from router.types.protobuf import Envelope, ProtoSchema


def link(
    table: RouteTable,
    schema: ProtoSchema,
    envelope: Envelope,
    routes: Sequence[CheckedRoute],
    gateways: Sequence[CheckedGateway] = (),
    own_topics: Sequence[tuple[Topic, MessageType]] = (),
    counters: Counters | None = None,
) -> Program:
    """Make the program of a checked table.

    `own_topics` are published by the router itself, whatever its routes do. A program that takes over from another
    one counts in `counters`, which continue those of the other (`Counters.continued`).
    """
    counters = counters or Counters()
    _open_counters(counters, table, envelope)
    _open_own_counters(counters, table)
    served = [checked for checked in routes if not checked.route.ignore]
    inbound: dict[int, tuple[Handler, ...]] = {}
    outbound: dict[str, tuple[Handler, ...]] = {}
    for checked in served:
        for handler in compile_handlers(checked, table, counters):
            if handler.topic is None:
                number = handler.case.number
                inbound[number] = (*inbound.get(number, ()), handler)
            else:
                outbound[handler.topic] = (*outbound.get(handler.topic, ()), handler)
    deadmen = tuple(
        _route_deadman(checked.route.name, checked.deadman, table, counters) for checked in served if checked.deadman
    )
    destinations = {to.endpoint.value for checked in served for to in checked.route.destinations}
    destinations |= {endpoint for plan in deadmen for endpoint, _ in plan.datagrams}
    return Program(
        table=table,
        envelope=envelope,
        counters=counters,
        senders=tuple(endpoint for endpoint in table.endpoints.values() if endpoint.name in destinations),
        publishers=_topics([*_published(served), *own_topics], _published_by_clients(gateways)),
        subscriptions=_topics((feed.topic, feed.type) for checked in served for feed in checked.subscriptions),
        inbound=inbound,
        outbound=outbound,
        deadmen=deadmen,
        ignored=frozenset(checked.case.number for checked in routes if checked.route.ignore),
        protos=schema,
        gateways=tuple(link_gateway(checked, counters) for checked in gateways),
    )


def _published(routes: Iterable[CheckedRoute]) -> Iterator[tuple[Topic, MessageType]]:
    """The topics that routes publish on."""
    for checked in routes:
        for used in checked.targets:
            if used.topic and used.type:
                yield used.topic, used.type


def _published_by_clients(gateways: Iterable[CheckedGateway]) -> Iterator[TopicPlan]:
    """The topics that clients of gateways publish on, under absolute names."""
    for gateway in gateways:
        for entry in gateway.inbound:
            yield _topic(entry.settings.topic, entry.type, entry.label)


def _topics(used: Iterable[tuple[Topic, MessageType]], more: Iterable[TopicPlan] = ()) -> tuple[TopicPlan, ...]:
    """One plan for each topic, however many routes name it; they agree on its type and QoS."""
    plans: dict[str, TopicPlan] = {}
    for plan in (*(_topic(topic, declared, topic.topic.value) for topic, declared in used), *more):
        plans.setdefault(plan.label, plan)
    return tuple(plans.values())


def _topic(topic: Topic, declared: MessageType, label: str) -> TopicPlan:
    return TopicPlan(label, topic.topic.value, declared.name, qos_of(topic), layout(declared))


def _open_counters(counters: Counters, table: RouteTable, envelope: Envelope) -> None:
    for listener in table.listeners:
        for name in ("datagrams_received", "received_bytes", "kernel_drops", "datagrams_padded"):
            counters.index(name, listener)
        for reason in REJECT_REASONS:
            counters.index("datagrams_rejected", listener, reason)
    for case in (*envelope.cases, UNKNOWN_CASE):
        counters.index("unhandled", case)
    for endpoint in table.endpoints:
        counters.index("endpoint_last_seen_timestamp_seconds", endpoint)


def _open_own_counters(counters: Counters, table: RouteTable) -> None:
    """The series of mirror, recorder and reloads."""
    for name in ("mirror_dropped", "config_last_reload_successful", "config_last_reload_timestamp_seconds"):
        counters.index(name)
    for result in RELOAD_RESULTS:
        counters.index("config_reloads", result)
    if table.record is not None:
        for name in ("recorded_datagrams", "recorded_bytes"):
            counters.index(name)
        for reason in RECORD_DROP_REASONS:
            counters.index("record_dropped", reason)


def compile_handlers(checked: CheckedRoute, table: RouteTable, counters: Counters) -> Iterator[Handler]:
    """Generate and compile the functions of one route, and open its series in the counters.

    A route from UDP has one function, a route from ROS one for each of its topics.
    """
    route, case = checked.route, checked.case
    counters.index("route_duration_seconds", route.name)
    counters.index("route_last_message_timestamp_seconds", route.name)
    for topic in route.topics:
        for policy in QOS_POLICIES:
            counters.index("qos_incompatible", route.name, topic.topic.value, policy)
    if not route.is_outbound:
        generator = HandlerSource(route, case, counters)
        generator.inbound(checked.targets, checked.collect)
        sources: list[str | None] = [source.value for source in route.sources]
        if ANY in sources:
            sources = [*table.endpoints, STRANGER]
        for source in sources:
            counters.index("messages_received", route.name, source_label(source))
        spans = [target.span for target in checked.targets if target.topic]
        yield _handler(generator, checked, (spans or [route.span])[0].file, frozenset(sources), None)
    for feed in checked.subscriptions:
        generator = HandlerSource(route, case, counters)
        generator.outbound(feed)
        yield _handler(generator, checked, feed.topic.span.file, frozenset(), feed.topic.topic.value)


def _handler(
    generator: HandlerSource, checked: CheckedRoute, file: str, sources: frozenset[str | None], topic: str | None
) -> Handler:
    """`file` is blamed in tracebacks: Python code has one, even of a route that is put together from several tables."""
    route = checked.route
    return Handler(
        route=route.name,
        case=checked.case,
        function=generator.function,
        source=generator.out.text(),
        code=generator.out.compile(file),
        constants={**NAMESPACE, **generator.out.constants},
        targets=tuple(generator.targets),
        sources=sources,
        topic=topic,
        ttl=route.ttl.value if route.ttl else None,
        collect_timeout=route.collect.timeout.value if route.collect else None,
    )


def _route_deadman(route: str, checked: CheckedDeadman, table: RouteTable, counters: Counters) -> DeadmanPlan:
    datagrams = []
    for to in checked.settings.to:
        trims = table.endpoints[to.value].trim_trailing_zeros
        datagrams.append((to.value, checked.datagram.rstrip(b"\0") if trims else checked.datagram))
    return _deadman(route, checked.settings, datagrams, counters)


def _deadman(
    name: str, settings: Deadman | InboundDeadman, datagrams: Iterable[tuple[str, bytes]], counters: Counters
) -> DeadmanPlan:
    plan = DeadmanPlan(
        name, settings.timeout.value, settings.repeat.value, tuple(datagrams), at_start=settings.at_start
    )
    for metric in ("deadman_active", "deadman_trips"):
        counters.index(metric, name)
    for to, _ in plan.datagrams:
        for metric in ("deadman_datagrams_sent", "deadman_send_errors"):
            counters.index(metric, name, to)
    return plan


# gateways


def link_gateway(checked: CheckedGateway, counters: Counters) -> GatewayPlan:
    """The plan of one gateway; opens its series in the counters."""
    settings = checked.settings
    _open_gateway_counters(counters, settings)
    return GatewayPlan(settings, {entry.label: _inbound(entry, settings.name, counters) for entry in checked.inbound})


def _inbound(entry: CheckedInbound, gateway: str, counters: Counters) -> InboundPlan:
    topic, settings = entry.label, entry.settings
    counters.index("messages_published", gateway, topic)
    for reason in INBOUND_DROP_REASONS:
        counters.index("messages_dropped", gateway, topic, reason)
    for policy in QOS_POLICIES:
        counters.index("qos_incompatible", gateway, topic, policy)
    deadman = None
    if settings.deadman is not None and entry.stop is not None:
        deadman = _deadman(f"{gateway}:{topic}", settings.deadman, [(topic, entry.stop)], counters)
    return InboundPlan(settings, topic, entry.type, deadman)


def _open_gateway_counters(counters: Counters, gateway: Gateway) -> None:
    name = gateway.name
    for metric in ("datagrams_received", "received_bytes", "gateway_clients", "gateway_client_clock_ahead"):
        counters.index(metric, name)
    counters.index("route_last_message_timestamp_seconds", name)
    for reason in GATEWAY_REJECT_REASONS:
        counters.index("datagrams_rejected", name, reason)
    for source in (ROS, CLIENTS):
        counters.index("messages_received", name, source)
    for metric in ("messages_sent", "messages_filtered"):
        counters.index(metric, name, CLIENTS)
    for reason in GATEWAY_DROP_REASONS:
        counters.index("messages_dropped", name, CLIENTS, reason)
    for metric in ("datagrams_sent", "sent_bytes"):
        counters.index(metric, name, gateway.transport.value.value)
    if gateway.zenoh is not None:
        counters.index("gateway_key_conflicts", name)
    for state in TOPIC_STATES:
        counters.index("gateway_topics", name, state)
    for reason in CLIENT_DROP_REASONS:
        counters.index("client_messages_dropped", name, reason)

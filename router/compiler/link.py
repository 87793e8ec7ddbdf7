"""Assemble the program: handlers, what must be opened for them, and the counters with every series.

Expects a table without errors: nothing here is checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from router.compiler.checked import CheckedDeadman, CheckedRoute
from router.compiler.commands import lower_commands
from router.compiler.deadmen import deadman_plan
from router.compiler.executors import executors
from router.compiler.handlers import HandlerSource
from router.compiler.lookup import layout
from router.compiler.lowering import lower_topics
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
    Program,
    TargetPlan,
    TopicPlan,
    source_label,
)
from router.compiler.topics import qos_of
from router.table.model import ANY, ROS, RouteTable, Topic
from router.types.board_limits import BoardLimits
from router.types.framing import trimmed
from router.types.model import MessageType
from router.types.protobuf import Envelope, ProtoSchema


def link(
    table: RouteTable,
    schema: ProtoSchema,
    envelope: Envelope,
    routes: Sequence[CheckedRoute],
    gateways: Sequence[GatewayPlan],
    boards: Mapping[str, BoardLimits],
    own_topics: Sequence[tuple[Topic, MessageType]],
    counters: Counters | None,
) -> Program:
    """Make the program of a checked table.

    `own_topics` are published by the router itself, whatever its routes do. A program that takes over from another
    one counts in `counters`, which continue those of the other (`Counters.continued`).
    """
    counters = counters or Counters()
    _open_counters(counters, table, envelope)
    _open_own_counters(counters, table)
    served = [checked for checked in routes if not checked.route.ignore]
    commands, topics = lower_commands(served), lower_topics(served, envelope)
    inbound: dict[int, tuple[Handler, ...]] = {}
    outbound: dict[str, tuple[Handler, ...]] = {}
    for checked in served:
        for handler in compile_handlers(checked, table, counters):
            if handler.topic is None:
                number = handler.case.number
                inbound[number] = (*inbound.get(number, ()), handler)
            else:
                outbound[handler.topic] = (*outbound.get(handler.topic, ()), handler)
    deadmen = tuple(_route_deadman(checked.route.name, checked.deadman, table) for checked in served if checked.deadman)
    for deadman in deadmen:
        _open_deadman_counters(counters, deadman)
    for gateway in gateways:
        _open_gateway_counters(counters, gateway)
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
        executors={**executors(served), **commands.executors, **topics.executors},
        commands=commands.commands,
        lowered=topics.routes,
        boards=boards,
        gateways=tuple(gateways),
    )


def _published(routes: Iterable[CheckedRoute]) -> Iterator[tuple[Topic, MessageType]]:
    """The topics that routes publish on."""
    for checked in routes:
        for used in checked.targets:
            if used.topic and used.type:
                yield used.topic, used.type


def _published_by_clients(gateways: Iterable[GatewayPlan]) -> Iterator[TopicPlan]:
    """The topics that clients of gateways publish on, under absolute names."""
    for gateway in gateways:
        for entry in gateway.inbound.values():
            yield _topic(entry.settings.topic, entry.type, entry.label)


def _topics(used: Iterable[tuple[Topic, MessageType]], more: Iterable[TopicPlan] = ()) -> tuple[TopicPlan, ...]:
    """One plan for each topic, however many routes name it; they agree on its type and QoS."""
    plans: dict[str, TopicPlan] = {}
    for plan in (*(_topic(topic, declared, topic.topic.value) for topic, declared in used), *more):
        plans.setdefault(plan.label, plan)
    return tuple(plans.values())


def _topic(topic: Topic, declared: MessageType, label: str) -> TopicPlan:
    return TopicPlan(label, topic.topic.value, declared.name, qos_of(topic), layout(declared))


def _open(counters: Counters, metrics: Iterable[str], *labels: str) -> None:
    for metric in metrics:
        counters.index(metric, *labels)


def _open_each(counters: Counters, metric: str, *labels: str, last: Iterable[str]) -> None:
    """Open a series for each value of the last label."""
    for value in last:
        counters.index(metric, *labels, value)


def _open_counters(counters: Counters, table: RouteTable, envelope: Envelope) -> None:
    for listener in table.listeners:
        _open(
            counters,
            ("datagrams_received", "received_bytes", "kernel_drops", "listener_waiting", "datagrams_padded"),
            listener,
        )
        _open_each(counters, "datagrams_rejected", listener, last=REJECT_REASONS)
    _open_each(counters, "unhandled", last=(*envelope.cases, UNKNOWN_CASE))
    _open_each(counters, "endpoint_last_seen_timestamp_seconds", last=table.endpoints)


def _open_own_counters(counters: Counters, table: RouteTable) -> None:
    """The series of mirror, recorder and reloads."""
    _open(counters, ("mirror_dropped", "config_last_reload_successful", "config_last_reload_timestamp_seconds"))
    _open_each(counters, "config_reloads", last=RELOAD_RESULTS)
    if table.record is not None:
        _open(counters, ("recorded_datagrams", "recorded_bytes"))
        _open_each(counters, "record_dropped", last=RECORD_DROP_REASONS)


def compile_handlers(checked: CheckedRoute, table: RouteTable, counters: Counters) -> Iterator[Handler]:
    """Generate and compile the functions of one route, and open its series in the counters.

    A route from UDP has one function, a route from ROS one for each of its topics.
    """
    route, case = checked.route, checked.case
    _open(counters, ("route_duration_seconds", "route_last_message_timestamp_seconds"), route.name)
    for topic in route.all_topics:
        _open_each(counters, "qos_incompatible", route.name, topic.topic.value, last=QOS_POLICIES)
    if not route.is_outbound:
        sources: list[str | None] = [source.value for source in route.sources]
        if ANY in sources:
            sources = [*table.endpoints, STRANGER]
        _open_each(counters, "messages_received", route.name, last=map(source_label, sources))
        yield _inbound_handler(checked, counters, frozenset(sources))
    for feed in checked.subscriptions:
        generator = HandlerSource(route, case, counters)
        generator.outbound(feed)
        yield _handler(generator, checked, feed.topic.span.file, frozenset(), feed.topic.topic.value)


def _inbound_handler(checked: CheckedRoute, counters: Counters, sources: frozenset[str | None]) -> Handler:
    """The handler of a route from UDP, and those of its parts once they are asked for."""
    route = checked.route
    spans = [target.span for target in checked.targets if target.topic]
    file = (spans or [route.span])[0].file
    generator = HandlerSource(route, checked.case, counters)
    generator.inbound(checked.targets, checked.collect)

    def compile_part(targets: Sequence[TargetPlan]) -> Handler:
        places = {(target.label, target.is_topic) for target in targets}
        served = [target for target in checked.targets if (target.label, target.topic is not None) in places]
        collect = checked.collect if any(target.topic for target in served) else None
        generator = HandlerSource(route, checked.case, counters)
        generator.inbound(checked.targets, collect, served)
        return _handler(generator, replace(checked, collect=collect), file, sources, None)

    return replace(_handler(generator, checked, file, sources, None), compile_part=compile_part)


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
        collect_timeout=route.collect.timeout.value if route.collect and checked.collect else None,
    )


def _route_deadman(route: str, checked: CheckedDeadman, table: RouteTable) -> DeadmanPlan:
    datagrams = []
    for to in checked.settings.to:
        trims = table.endpoints[to.value].trim_trailing_zeros
        datagrams.append((to.value, trimmed(checked.datagram) if trims else checked.datagram))
    return deadman_plan(route, checked.settings, datagrams)


def _open_deadman_counters(counters: Counters, plan: DeadmanPlan) -> None:
    _open(counters, ("deadman_active", "deadman_trips"), plan.route)
    for to, _ in plan.datagrams:
        _open(counters, ("deadman_datagrams_sent", "deadman_send_errors"), plan.route, to)


def _open_gateway_counters(counters: Counters, plan: GatewayPlan) -> None:
    name = plan.settings.name
    _open(counters, ("datagrams_received", "received_bytes", "gateway_clients", "gateway_client_clock_ahead"), name)
    _open(counters, ("route_last_message_timestamp_seconds",), name)
    _open_each(counters, "datagrams_rejected", name, last=GATEWAY_REJECT_REASONS)
    _open_each(counters, "messages_received", name, last=(ROS, CLIENTS))
    _open(counters, ("messages_sent", "messages_filtered"), name, CLIENTS)
    _open_each(counters, "messages_dropped", name, CLIENTS, last=GATEWAY_DROP_REASONS)
    _open(counters, ("datagrams_sent", "sent_bytes"), name, plan.settings.transport.value.value)
    if plan.settings.zenoh is not None:
        _open(counters, ("gateway_key_conflicts",), name)
        _open(counters, ("gateway_connections",), name, plan.settings.zenoh.mode)
    _open_each(counters, "gateway_topics", name, last=TOPIC_STATES)
    _open_each(counters, "client_messages_dropped", name, last=CLIENT_DROP_REASONS)
    for topic, inbound in plan.inbound.items():
        _open(counters, ("messages_published",), name, topic)
        _open_each(counters, "messages_dropped", name, topic, last=INBOUND_DROP_REASONS)
        _open_each(counters, "qos_incompatible", name, topic, last=QOS_POLICIES)
        if inbound.deadman is not None:
            _open_deadman_counters(counters, inbound.deadman)

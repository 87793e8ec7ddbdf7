"""Assemble the program: routes, what must be opened for them, and the counters.

Expects a table without errors: nothing here is checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from router.compiler.checked import CheckedDeadman, CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.deadmen import deadman_plan
from router.compiler.lookup import layout
from router.compiler.lowering import Lowered
from router.compiler.metrics import Counters
from router.compiler.program import (
    STRANGER,
    DeadmanPlan,
    GatewayPlan,
    Program,
    RoutePlan,
    TargetPlan,
    TopicPlan,
)
from router.compiler.series import open_series
from router.compiler.topics import qos_of
from router.table.model import ANY, Route, RouteTable, Topic
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
    lowered: Lowered,
    counters: Counters | None,
) -> Program:
    """Make the program of a checked table, of which `lowered` is what the carrier runs.

    `own_topics` are published by the router itself, whatever its routes do. A program that takes over from another
    one counts in `counters`, which continue those of the other (`Counters.continued`).
    """
    counters = counters or Counters()
    served = [checked for checked in routes if not checked.route.ignore]
    plans = [plan for checked in served for plan in _route_plans(checked, table, counters)]
    inbound: dict[int, tuple[RoutePlan, ...]] = {}
    outbound: dict[str, tuple[RoutePlan, ...]] = {}
    for plan in plans:
        if plan.topic is None:
            number = plan.case.number
            inbound[number] = (*inbound.get(number, ()), plan)
        else:
            outbound[plan.topic] = (*outbound.get(plan.topic, ()), plan)
    deadmen = tuple(_route_deadman(checked.route.name, checked.deadman, table) for checked in served if checked.deadman)
    open_series(counters, table, envelope, plans, deadmen, gateways)
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
        lowered=lowered,
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


def _route_plans(checked: CheckedRoute, table: RouteTable, counters: Counters) -> Iterator[RoutePlan]:
    """A route from UDP has one plan, a route from ROS one for each of its topics."""
    if not checked.route.is_outbound:
        yield _route_plan(checked, None, _sources(checked.route, table), counters)
    for feed in checked.subscriptions:
        yield _route_plan(checked, feed, frozenset(), counters)


def _sources(route: Route, table: RouteTable) -> frozenset[str | None]:
    sources = frozenset(source.value for source in route.sources)
    return frozenset([*table.endpoints, STRANGER]) if ANY in sources else sources


def _route_plan(
    checked: CheckedRoute, feed: CheckedSubscription | None, sources: frozenset[str | None], counters: Counters
) -> RoutePlan:
    """The plan of `feed`, or of a route from UDP."""
    route = checked.route
    targets = feed.targets if feed else checked.targets
    return RoutePlan(
        route=route.name,
        case=checked.case,
        targets=tuple(map(_target_plan, targets)),
        sources=sources,
        topic=feed.topic.topic.value if feed else None,
        ttl=route.ttl.value if route.ttl else None,
        collect_timeout=route.collect.timeout.value if route.collect and checked.collect else None,
    )


def _target_plan(target: CheckedTarget) -> TargetPlan:
    return TargetPlan(
        label=target.label,
        is_topic=target.topic is not None,
        max_rate=target.declared.max_rate,
        on_limit=target.declared.on_limit,
        priority=target.priority,
        is_deferred=target.is_deferred,
        deadmen=target.deadmen,
    )


def _route_deadman(route: str, checked: CheckedDeadman, table: RouteTable) -> DeadmanPlan:
    datagrams = []
    for to in checked.settings.to:
        trims = table.endpoints[to.value].trim_trailing_zeros
        datagrams.append((to.value, trimmed(checked.datagram) if trims else checked.datagram))
    return deadman_plan(route, checked.settings, datagrams)

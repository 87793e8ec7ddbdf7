"""Assembles the program: routes, the sockets and topics that they need, and the counters.

Expects a table without errors and checks nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from router.compiler.checked import (
    CheckedCalled,
    CheckedRoute,
    CheckedService,
    CheckedState,
    CheckedSubscription,
    Target,
)
from router.compiler.compiled_table import (
    CALL_FAILURES,
    STRANGER,
    CalledPlan,
    CompiledTable,
    GatewayPlan,
    RoutePlan,
    ServicePlan,
    StatePlan,
    TopicPlan,
    is_service,
)
from router.compiler.lookup import definitions_of
from router.compiler.lowering import Lowered
from router.compiler.metrics import Counters
from router.compiler.series import open_series
from router.compiler.states import states_read
from router.compiler.topics import qos_of
from router.table.model import RouteTable
from router.table.model.routes import ANY, Route
from router.table.model.targets import Topic
from router.table.units import duration
from router.types.model import MessageType

if TYPE_CHECKING:
    from router.compiler.check import Checked


def link(checked: Checked, counters: Counters) -> CompiledTable | None:
    """Make the program of a table, which counts in `counters`; None if the table has errors."""
    table, envelopes, lowered = checked.table, checked.envelopes, checked.lowered
    if table is None or envelopes is None or lowered is None:
        return None
    served = [route for route in checked.routes if not route.route.ignore]
    inbound: dict[str, tuple[RoutePlan, ...]] = {}
    outbound: dict[str, tuple[RoutePlan, ...]] = {}
    for route in served:
        if not route.route.is_outbound:
            name = route.case.name
            inbound[name] = (*inbound.get(name, ()), _route_plan(route, lowered, _sources(route.route, table)))
        for feed in route.subscriptions:
            topic = feed.topic.topic.value
            outbound[topic] = (*outbound.get(topic, ()), _route_plan(route, lowered, frozenset(), feed))
    for state in checked.states.values():
        if state.feed is not None:
            topic = state.feed.topic.topic.value
            plan = RoutePlan(state.label, None, (), frozenset(), topic)
            outbound[topic] = (*outbound.get(topic, ()), plan)
    deadmen = tuple(route.deadman for route in served if route.deadman)
    destinations = {to.endpoint.value for route in served for to in route.route.destinations}
    destinations |= {target.label for route in served for target in route.targets if target.reply}
    destinations |= {endpoint for plan in deadmen for endpoint, _ in plan.datagrams}
    services = tuple(map(_service, checked.services))
    called = tuple(map(_called, checked.called))
    program = CompiledTable(
        table=table,
        envelopes=envelopes,
        counters=counters,
        senders=tuple(endpoint for endpoint in table.endpoints.values() if endpoint.name in destinations),
        publishers=_topics([*_published(served), *checked.own_topics], _published_by_clients(checked.gateways)),
        subscriptions=_topics(
            (feed.topic, feed.type)
            for feed in [*_feeds(served), *_feeds_of_states(checked)]
            if not is_service(feed.topic.topic.value)
        ),
        inbound=inbound,
        outbound=outbound,
        deadmen=deadmen,
        ignored=frozenset(route.case.value for route in table.routes if route.ignore),
        lowered=lowered,
        boards=checked.boards,
        gateways=tuple(checked.gateways),
        services=services,
        called=called,
        states=tuple(_state(state, lowered, inbound, served) for state in checked.states.values()),
    )
    open_series(program)
    return program


def _state(
    state: CheckedState,
    lowered: Lowered,
    inbound: Mapping[str, Iterable[RoutePlan]],
    served: Iterable[CheckedRoute],
) -> StatePlan:
    declared = state.declared
    if state.feed is not None:
        taken = {state.label: {state.feed.topic.topic.value}}
    else:
        names = {source.value for source in declared.sources}
        plans = inbound.get(state.case.name, ()) if state.case is not None else ()
        taken = {plan.route: names & plan.sources for plan in plans}
    return StatePlan(
        declared.name,
        state.kind,
        state.initial,
        (declared.valid_for.value or None) if declared.valid_for else None,
        {route: sources for route, sources in taken.items() if sources},
        [each.route.name for each in served if declared.name in states_read(each)],
        lowered.states[declared.name].place,
    )


def _service(checked: CheckedService) -> ServicePlan:
    declared = checked.declared
    return ServicePlan(
        name=declared.name,
        ros_name=checked.ros_name,
        type_name=declared.type.value,
        definitions=definitions_of(checked.request_type) | definitions_of(checked.response_type),
        endpoint=declared.request.to.value,
        match=checked.match,
        group=checked.group,
        most=checked.most,
        timeout=declared.timeout.value,
        retries=declared.retries,
        responses=checked.responses,
        span=declared.span,
    )


def _called(checked: CheckedCalled) -> CalledPlan:
    call = checked.declared.call
    words = {"service": call.service.value, "timeout": duration(call.timeout.value)}
    return CalledPlan(
        name=checked.declared.name,
        service=call.service.value,
        type_name=call.type.value,
        definitions=definitions_of(checked.request_type) | definitions_of(checked.response_type),
        kept=checked.kept,
        timeout=call.timeout.value,
        reasons={outcome: text.format(**words) for outcome, text in CALL_FAILURES.items()},
        span=checked.declared.span,
    )


def _feeds(routes: Iterable[CheckedRoute]) -> Iterator[CheckedSubscription]:
    for checked in routes:
        yield from checked.subscriptions


def _feeds_of_states(checked: Checked) -> Iterator[CheckedSubscription]:
    yield from (state.feed for state in checked.states.values() if state.feed is not None)


def _published(routes: Iterable[CheckedRoute]) -> Iterator[tuple[Topic, MessageType]]:
    """Yield the topics that routes publish on, without targets that are services."""
    for checked in routes:
        for used in checked.targets:
            if used.topic and used.type and not is_service(used.label):
                yield used.topic, used.type


def _published_by_clients(gateways: Iterable[GatewayPlan]) -> Iterator[TopicPlan]:
    """Yield the topics that clients of gateways publish on, under absolute names."""
    for gateway in gateways:
        for inbound in gateway.inbound.values():
            yield _topic(inbound.settings.topic, inbound.type, inbound.label)


def _topics(used: Iterable[tuple[Topic, MessageType]], more: Iterable[TopicPlan] = ()) -> tuple[TopicPlan, ...]:
    """Return one plan per topic. Routes that name the same topic agree on its type and QoS."""
    plans: dict[str, TopicPlan] = {}
    for plan in (*(_topic(topic, declared, topic.topic.value) for topic, declared in used), *more):
        plans.setdefault(plan.label, plan)
    return tuple(plans.values())


def _topic(topic: Topic, declared: MessageType, label: str) -> TopicPlan:
    return TopicPlan(label, topic.topic.value, declared.name, qos_of(topic), definitions_of(declared))


def _sources(route: Route, table: RouteTable) -> frozenset[str | None]:
    sources = frozenset(source.value for source in route.sources)
    return frozenset([*table.endpoints, STRANGER]) if ANY in sources else sources


def _route_plan(
    checked: CheckedRoute, lowered: Lowered, sources: frozenset[str | None], feed: CheckedSubscription | None = None
) -> RoutePlan:
    """Return the plan of `feed`, or of a route from UDP."""
    route = checked.route
    return RoutePlan(
        route=route.name,
        case=checked.case,
        targets=tuple(_targets(checked, lowered, feed)),
        sources=sources,
        topic=feed.topic.topic.value if feed else None,
        ttl=route.ttl.value if route.ttl else None,
        collect_timeout=route.collect.timeout.value if route.collect and checked.collect else None,
    )


def _targets(checked: CheckedRoute, lowered: Lowered, feed: CheckedSubscription | None) -> Iterator[Target]:
    """Yield the targets with their routines, which a destination that gets every datagram does not have."""
    name = checked.route.name
    if feed is not None:
        feeds = {served.route: served for served in lowered.from_ros[feed.topic.topic.value]}
        yield from feeds[name].targets.values()
    for target in checked.targets:
        kind = lowered.to_topics if target.is_topic else lowered.replies if target.reply else lowered.to_destinations
        route = kind.get(name)
        yield route.targets.get(target.label, target) if route else target

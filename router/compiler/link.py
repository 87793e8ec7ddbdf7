"""Puts checked routes and gateways together: handlers, what must be opened for them, and the books with every series.

Expects a table without errors: nothing here is checked, and nothing is found.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from router.compiler.books import (
    QOS_POLICIES,
    RECORD_DROP_REASONS,
    REJECT_REASONS,
    RELOAD_RESULTS,
    UNKNOWN_CASE,
    Books,
)
from router.compiler.checked import CheckedDeadman, CheckedGateway, CheckedRoute
from router.compiler.handlers import HandlerSource
from router.compiler.link_gateways import link_gateway
from router.compiler.lookup import layout
from router.compiler.namespace import NAMESPACE
from router.compiler.program import (
    STRANGER,
    DeadmanPlan,
    Handler,
    ListenerPlan,
    Program,
    SenderPlan,
    TopicPlan,
    source_label,
)
from router.compiler.topics import qos_of
from router.table.model import ANY, RouteTable, Topic
from router.types.model import MessageType
from router.types.protobuf import Envelope, ProtoSchema


def link(
    table: RouteTable,
    schema: ProtoSchema,
    envelope: Envelope,
    routes: Sequence[CheckedRoute],
    gateways: Sequence[CheckedGateway] = (),
    own_topics: Sequence[tuple[Topic, MessageType]] = (),
    books: Books | None = None,
) -> Program:
    """`own_topics` are published by the router itself, whatever its routes do.

    `books` are to be counted in, where the program takes over from another one (`Books.continued`).
    """
    books = books or Books()
    _open_books(books, table, envelope)
    _open_own_books(books, table)
    served = [checked for checked in routes if not checked.route.ignore]
    inbound: dict[int, tuple[Handler, ...]] = {}
    outbound: dict[str, tuple[Handler, ...]] = {}
    for checked in served:
        for handler in compile_handlers(checked, table, books):
            if handler.topic is None:
                number = handler.case.number
                inbound[number] = (*inbound.get(number, ()), handler)
            else:
                outbound[handler.topic] = (*outbound.get(handler.topic, ()), handler)
    deadmen = tuple(
        _deadman(checked.route.name, checked.deadman, table, books) for checked in served if checked.deadman
    )
    destinations = {to.endpoint.value for checked in served for to in checked.route.destinations}
    destinations |= {endpoint for plan in deadmen for endpoint, _ in plan.datagrams}
    return Program(
        table=table,
        envelope=envelope,
        books=books,
        listeners=tuple(
            ListenerPlan(
                one.name,
                one.address.value,
                one.framing,
                one.receive_buffer,
                one.coalesce,
                one.interface.value if one.interface else None,
            )
            for one in table.listeners.values()
        ),
        senders=tuple(
            SenderPlan(one.name, one.address.value, one.budget.value if one.budget else None)
            for one in table.endpoints.values()
            if one.name in destinations
        ),
        publishers=_topics([*_published(served), *own_topics], _let_in(gateways)),
        subscriptions=_topics((feed.topic, feed.type) for checked in served for feed in checked.feeds),
        inbound=inbound,
        outbound=outbound,
        deadmen=deadmen,
        ignored=frozenset(checked.case.number for checked in routes if checked.route.ignore),
        protos=schema,
        gateways=tuple(link_gateway(checked, books) for checked in gateways),
    )


def _published(routes: Iterable[CheckedRoute]) -> Iterator[tuple[Topic, MessageType]]:
    """What routes fill."""
    for checked in routes:
        for used in checked.targets:
            if used.topic and used.type:
                yield used.topic, used.type


def _let_in(gateways: Iterable[CheckedGateway]) -> Iterator[TopicPlan]:
    """What clients of gateways publish, under absolute names."""
    for gateway in gateways:
        for entry in gateway.inbound:
            yield _topic(entry.inbound.topic, entry.type, entry.topic)


def _topics(used: Iterable[tuple[Topic, MessageType]], more: Iterable[TopicPlan] = ()) -> tuple[TopicPlan, ...]:
    """One for each topic, however many routes name it: the check has seen to it that they agree."""
    plans: dict[str, TopicPlan] = {}
    for plan in (*(_topic(topic, declared, topic.topic.value) for topic, declared in used), *more):
        plans.setdefault(plan.topic, plan)
    return tuple(plans.values())


def _topic(topic: Topic, declared: MessageType, label: str) -> TopicPlan:
    return TopicPlan(label, topic.topic.value, declared.name, qos_of(topic), layout(declared))


def _open_books(books: Books, table: RouteTable, envelope: Envelope) -> None:
    for listener in table.listeners:
        for name in ("datagrams_received", "received_bytes", "kernel_drops", "datagrams_padded"):
            books.slot(name, listener)
        for reason in REJECT_REASONS:
            books.slot("datagrams_rejected", listener, reason)
    for case in (*envelope.cases, UNKNOWN_CASE):
        books.slot("unhandled", case)
    for endpoint in table.endpoints:
        books.slot("endpoint_last_seen_timestamp_seconds", endpoint)


def _open_own_books(books: Books, table: RouteTable) -> None:
    """Of what the router does beside routing."""
    for name in ("mirror_dropped", "config_last_reload_successful", "config_last_reload_timestamp_seconds"):
        books.slot(name)
    for result in RELOAD_RESULTS:
        books.slot("config_reloads", result)
    if table.record is not None:
        for name in ("recorded_datagrams", "recorded_bytes"):
            books.slot(name)
        for reason in RECORD_DROP_REASONS:
            books.slot("record_dropped", reason)


def compile_handlers(checked: CheckedRoute, table: RouteTable, books: Books) -> Iterator[Handler]:
    """Generates and compiles the functions of one route, and opens its series in the books.

    A route from UDP has one, a route from ROS one for each of its topics.
    """
    route, case = checked.route, checked.case
    books.slot("route_seconds", route.name)
    books.slot("route_last_message_timestamp_seconds", route.name)
    for topic in route.topics:
        for policy in QOS_POLICIES:
            books.slot("qos_incompatible", route.name, topic.topic.value, policy)
    if not route.is_outbound:
        generator = HandlerSource(route, case, books)
        generator.inbound([served.target for served in checked.targets], checked.collect)
        sources: list[str | None] = [source.value for source in route.sources]
        if ANY in sources:
            sources = [*table.endpoints, STRANGER]
        for source in sources:
            books.slot("messages_received", route.name, source_label(source))
        spans = [served.target.span for served in checked.targets if served.topic]
        yield _handler(generator, checked, (spans or [route.span])[0].file, frozenset(sources), None)
    for feed in checked.feeds:
        generator = HandlerSource(route, case, books)
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
        targets=generator.plans,
        sources=sources,
        topic=topic,
        ttl=route.ttl.value if route.ttl else None,
        collect_timeout=route.collect.timeout.value if route.collect else None,
    )


def _deadman(route: str, deadman: CheckedDeadman, table: RouteTable, books: Books) -> DeadmanPlan:
    for metric in ("deadman_active", "deadman_trips"):
        books.slot(metric, route)
    for endpoint in deadman.to:
        for metric in ("deadman_datagrams_sent", "deadman_send_errors"):
            books.slot(metric, route, endpoint)
    return DeadmanPlan(
        route=route,
        timeout=deadman.timeout,
        repeat=deadman.repeat,
        datagrams=tuple(
            (name, deadman.datagram.rstrip(b"\0") if table.endpoints[name].trim_trailing_zeros else deadman.datagram)
            for name in deadman.to
        ),
        at_start=deadman.at_start,
    )

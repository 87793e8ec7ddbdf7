"""Puts checked routes together: their handlers, what must be opened for them, and the books with every series.

Expects a table without errors: nothing here is checked, and nothing is found.
"""

from __future__ import annotations

from collections.abc import Sequence

from router.compiler.books import REJECT_REASONS, UNKNOWN_CASE, Books
from router.compiler.handlers import HandlerSource
from router.compiler.namespace import NAMESPACE
from router.compiler.program import (
    STRANGER,
    Handler,
    ListenerPlan,
    Program,
    SenderPlan,
    TopicPlan,
    source_label,
)
from router.compiler.routes import CheckedRoute, nested_types
from router.compiler.topics import qos_of
from router.table.model import ANY, RouteTable
from router.types.model import MessageType
from router.types.protobuf import Envelope, ProtoSchema
from router.types.ros import definition


def link(table: RouteTable, schema: ProtoSchema, envelope: Envelope, routes: Sequence[CheckedRoute]) -> Program:
    books = Books()
    _open_books(books, table, envelope)
    inbound = [checked for checked in routes if not checked.route.ignore and not checked.route.is_outbound]
    destinations = {to.endpoint.value for checked in inbound for to in checked.route.destinations}
    return Program(
        table=table,
        envelope=envelope,
        books=books,
        listeners=tuple(
            ListenerPlan(one.name, one.address.value, one.framing, one.receive_buffer)
            for one in table.listeners.values()
        ),
        senders=tuple(
            SenderPlan(one.name, one.address.value) for one in table.endpoints.values() if one.name in destinations
        ),
        publishers=_publishers(inbound),
        subscriptions=(),
        inbound={checked.case.number: (compile_handler(checked, table, books),) for checked in inbound},
        outbound={},
        deadmen=(),
        ignored=frozenset(checked.case.number for checked in routes if checked.route.ignore),
        protos_sha256=schema.sha256,
    )


def _publishers(routes: Sequence[CheckedRoute]) -> tuple[TopicPlan, ...]:
    """One for each topic, however many routes publish on it: the check has seen to it that they agree."""
    plans: dict[str, TopicPlan] = {}
    for checked in routes:
        for served in checked.targets:
            if served.topic and served.type:
                name, qos = served.topic.topic.value, qos_of(served.topic)
                plans.setdefault(name, TopicPlan(name, served.type.name, qos, _definitions(served.type)))
    return tuple(plans.values())


def _definitions(message: MessageType) -> dict[str, tuple[tuple[str, str], ...]]:
    return {nested.name: definition(nested) for nested in nested_types(message)}


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


def compile_handler(checked: CheckedRoute, table: RouteTable, books: Books) -> Handler:
    """Generates and compiles the function of one inbound route, and opens its series in the books."""
    route, case = checked.route, checked.case
    generator = HandlerSource(case.name, books, route.case.span)
    generator.generate([served.target for served in checked.targets])
    sources: list[str | None] = [source.value for source in route.sources]
    if ANY in sources:
        sources = [*table.endpoints, STRANGER]
    for source in sources:
        books.slot("messages_received", case.name, source_label(source))
    books.slot("route_seconds", case.name)
    books.slot("route_last_message_timestamp_seconds", case.name)
    return Handler(
        route=route.name,
        case=case,
        function=generator.function,
        source=generator.out.text(),
        code=generator.out.compile(_blamed_file(checked)),
        constants={**NAMESPACE, **generator.out.constants},
        targets=tuple(generator.plans),
        sources=frozenset(sources),
    )


def _blamed_file(checked: CheckedRoute) -> str:
    """Python code has one file name; of a route that is put together from several tables, the topics' wins."""
    spans = [served.target.span for served in checked.targets if served.topic]
    return (spans[0] if spans else checked.route.case.span).file

"""What a route table means: RouteTable and types in, findings or a Program out.

Knows no socket, no rclpy and no clock; the same check serves `validate`, `explain` and `run`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from router.compiler.books import REJECT_REASONS, UNKNOWN_CASE, Books
from router.compiler.cdr import RUNTIME
from router.compiler.definitions import Definitions
from router.compiler.functions import FUNCTIONS
from router.compiler.handlers import HandlerSource
from router.compiler.implementations import fit, fit_text, fit_wide_text
from router.compiler.network import network_findings
from router.compiler.program import Handler, ListenerPlan, Program, PublisherPlan, SenderPlan
from router.compiler.routes import CheckedRoute, RouteChecker, nested_types, sorted_findings
from router.compiler.topics import meeting_findings, qos_of
from router.errors import Diagnostic, Severity, TableError
from router.table import load_table
from router.table.model import ANY, RouteTable
from router.types.lock import check_lock, locked_size
from router.types.model import MessageType
from router.types.protobuf import Envelope, ProtoSchema, find_envelope
from router.types.ros import definition

STRANGER = None
"""Stands among a handler's sources for a sender that is no endpoint of the table."""

_CALLABLE = {name: function.implementation for name, function in FUNCTIONS.items()}
_NAMESPACE = {**_CALLABLE, **RUNTIME, "fit": fit, "fit_text": fit_text, "fit_wide_text": fit_wide_text, "ZERO": b"\0"}


@dataclass(frozen=True)
class Checked:
    """A table after all checks. `program` is None while there is an error among the findings."""

    path: Path
    diagnostics: Sequence[Diagnostic]
    table: RouteTable | None = None
    schema: ProtoSchema | None = None
    envelope: Envelope | None = None
    routes: Sequence[CheckedRoute] = ()

    @property
    def has_errors(self) -> bool:
        return any(finding.severity is Severity.ERROR for finding in self.diagnostics)

    @cached_property
    def program(self) -> Program | None:
        """Made when first asked for: `validate` needs none."""
        if self.has_errors or self.table is None or self.schema is None or self.envelope is None:
            return None
        return _program(self.table, self.schema, self.envelope, self.routes)


def check_table(
    path: Path, environ: Mapping[str, str] | None = None, definitions: Definitions | None = None
) -> Checked:
    """Checks a table and everything that it refers to. Never raises for what a person may have written.

    `environ` fills the table's variables, None means the process environment. Pass one `definitions` to
    several calls to read `.proto` files and ROS interfaces once.
    """
    table, findings = load_table(path, environ)
    if table is None:
        return Checked(path, sorted_findings(findings))
    definitions = definitions or Definitions()
    try:
        schema = definitions.protos(table.envelope.protos.value, table.envelope.protos.span)
        envelope = find_envelope(schema, table.envelope)
    except TableError as error:
        return Checked(path, sorted_findings([*findings, *error.diagnostics, *network_findings(table)]), table)
    checker = RouteChecker(table, schema, envelope, definitions, locked_size(schema) or envelope.max_size)
    routes = checker.check_all()
    findings = [
        *findings,
        *check_lock(schema, envelope),
        *network_findings(table),
        *checker.findings,
        *meeting_findings(table, [checked.route for checked in routes]),
    ]
    return Checked(path, sorted_findings(findings), table, schema, envelope, routes)


def _program(table: RouteTable, schema: ProtoSchema, envelope: Envelope, routes: Sequence[CheckedRoute]) -> Program:
    books = Books()
    _open_books(books, table, envelope)
    inbound = [checked for checked in routes if not checked.route.ignore and not checked.route.is_outbound]
    destinations = {to.endpoint.value for checked in inbound for to in checked.route.destinations}
    publishers: dict[str, PublisherPlan] = {}
    for checked in inbound:
        for served in checked.targets:
            if served.topic and served.type:
                topic = served.topic
                plan = PublisherPlan(topic.topic.value, served.type.name, qos_of(topic), _definitions(served.type))
                publishers.setdefault(plan.topic, plan)
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
        publishers=tuple(publishers.values()),
        handlers={checked.case.number: compile_handler(checked, table, books) for checked in inbound},
        ignored=frozenset(checked.case.number for checked in routes if checked.route.ignore),
        declared_outbound=tuple(checked.case.name for checked in routes if checked.route.is_outbound),
        protos_sha256=schema.sha256,
    )


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
    names = [source.value for source in route.sources]
    sources = frozenset([*table.endpoints, STRANGER] if ANY in names else names)
    for source in sources:
        books.slot("messages_received", case.name, source_label(source))
    books.slot("route_seconds", case.name)
    books.slot("route_last_message_timestamp_seconds", case.name)
    return Handler(
        case=case,
        function=generator.function,
        source=generator.out.text(),
        code=generator.out.compile(_blamed_file(checked)),
        constants={**_NAMESPACE, **generator.out.constants},
        targets=tuple(generator.plans),
        sources=sources,
    )


def source_label(source: str | None) -> str:
    """The `source` label of a sender: its name, or `unknown` for a stranger on a route that takes any."""
    return source if source is not None else "unknown"


def _blamed_file(checked: CheckedRoute) -> str:
    """Python code has one file name; of a route that is put together from several tables, the topics' wins."""
    spans = [served.target.span for served in checked.targets if served.topic]
    return (spans[0] if spans else checked.route.case.span).file

"""Checks a table and everything that it refers to, and collects all findings.

`validate`, `explain` and `run` use the same check.
"""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from router.compiler.beside import check_beside, unfilled
from router.compiler.brakes import brake_findings
from router.compiler.called import check_called
from router.compiler.checked import CheckedCalled, CheckedRoute, CheckedService, CheckedState
from router.compiler.compiled_table import CompiledTable, GatewayPlan
from router.compiler.envelopes import envelope_findings, shared_lock_findings
from router.compiler.gateways import check_gateways
from router.compiler.lookup import Definitions, Lookup
from router.compiler.lowering import Lowered, lower_table
from router.compiler.metrics import Counters
from router.compiler.network_findings import network_findings
from router.compiler.replies import reply_findings
from router.compiler.routes import check_routes, clash_findings
from router.compiler.services import check_services
from router.compiler.states import check_states, condition_findings
from router.compiler.topics import diagnostics_topic, topic_findings, with_types
from router.errors import Code, Diagnostic, Severity, TableError
from router.table import in_order, load_table
from router.table.model import RouteTable
from router.table.model.endpoints import EndpointKind
from router.table.model.targets import Topic
from router.types.board_limits import (
    MOST_LISTS,
    MOST_MESSAGES,
    BoardLimits,
    board_fields,
    payload_fields,
    places,
)
from router.types.envelopes import chosen_envelope
from router.types.lock import LockComparison
from router.types.model import MessageType
from router.types.protobuf import Envelope, no_envelope
from router.types.table_envelopes import Envelopes, told_apart, written_alike


@contextmanager
def uncollected() -> Iterator[None]:
    """Pause garbage collection, which would repeatedly traverse all objects of a large table without freeing any."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@dataclass(frozen=True)
class Checked:
    """A table after all checks. `program` is None if any finding is an error."""

    path: Path
    diagnostics: Sequence[Diagnostic]
    table: RouteTable | None = None
    envelopes: Envelopes | None = None
    routes: Sequence[CheckedRoute] = ()
    gateways: Sequence[GatewayPlan] = ()
    boards: Mapping[str, BoardLimits] = field(default_factory=dict)
    own_topics: Sequence[tuple[Topic, MessageType]] = ()
    states: Mapping[str, CheckedState] = field(default_factory=dict)
    services: Sequence[CheckedService] = ()
    called: Sequence[CheckedCalled] = ()
    lowered: Lowered | None = None

    @property
    def has_errors(self) -> bool:
        return _has_errors(self.diagnostics)

    @cached_property
    def program(self) -> CompiledTable | None:
        """The program, compiled on first use; None if there are errors."""
        return self.program_in(Counters())

    @uncollected()
    def program_in(self, counters: Counters) -> CompiledTable | None:
        """Compile the program, which counts in `counters`; None if there are errors.

        A program that replaces another one continues its counters (`Counters.continued`).
        """
        from router.compiler.link import link

        return link(self, counters)


@uncollected()
def check_table(
    path: Path, environ: Mapping[str, str] | None = None, definitions: Definitions | None = None
) -> Checked:
    """Check a table and everything that it refers to. Mistakes in these files are findings, never exceptions.

    `environ` has the values of variables, by default the process environment. Pass one `definitions` to several calls
    to read `.proto` files and ROS interfaces once.
    """
    table, findings = load_table(path, environ)
    if table is None:
        return Checked(path, in_order(findings))
    definitions = definitions or Definitions()
    try:
        envelopes = _envelopes(table, definitions)
    except TableError as error:
        return Checked(path, in_order([*findings, *error.diagnostics, *network_findings(table)]), table)
    table = with_types(table, envelopes.cases, findings)
    locks = {
        name: LockComparison(envelope, path) for name, envelope in envelopes.by_name.items() if name in table.envelopes
    }
    boards = _boards(table, envelopes, locks)
    lookup = Lookup(table, envelopes, definitions, boards)
    lookup.beside = check_beside(lookup)
    states = check_states(lookup)
    own_routes = check_routes(lookup)
    services, routes = check_services(lookup, own_routes)
    called, routes = check_called(lookup, routes)
    gateways = check_gateways(lookup)
    own = diagnostics_topic(table.node)
    own_type = lookup.ros_type(own) if own else None
    findings = [
        *findings,
        *dict.fromkeys(warning for schema in envelopes.schemas for warning in schema.warnings),
        *(finding for name, lock in locks.items() for finding in lock.findings(table.envelopes[name].lock)),
        *network_findings(table),
        *envelope_findings(table),
        *shared_lock_findings(table),
        *_board_findings(table, boards),
        *_envelope_findings(lookup, routes),
        *_unused_sets(lookup, routes),
        *lookup.findings,
        *condition_findings(lookup, routes),
        *clash_findings(table),
        *reply_findings(routes),
        *brake_findings(table, own_routes),
        *topic_findings(table, [checked.route for checked in own_routes]),
    ]
    own_topics = [(own, own_type)] if own and own_type else []
    lowered = None
    if not _has_errors(findings):
        lowered, limits = lower_table(routes, envelopes, states)
        findings += limits
        lowered = None if limits else lowered
    for schema in envelopes.schemas:
        schema.sources.close()
    return Checked(
        path,
        in_order(findings),
        table,
        envelopes,
        routes,
        gateways,
        boards,
        own_topics,
        states,
        services,
        called,
        lowered,
    )


def _has_errors(findings: Iterable[Diagnostic]) -> bool:
    return any(finding.severity is Severity.ERROR for finding in findings)


def _boards(table: RouteTable, envelopes: Envelopes, locks: Mapping[str, LockComparison]) -> Mapping[str, BoardLimits]:
    """Return the limits of each board by name."""
    boards = [endpoint for endpoint in table.endpoints.values() if endpoint.kind is EndpointKind.BOARD]
    of_envelope = {
        name: _limits(table, envelopes, envelopes.by_name[name], lock)
        for name, lock in locks.items()
        if any(envelopes.endpoints[board.name] == name for board in boards)
    }
    return {
        board.name: replace(of_envelope[name], allows_non_finite=board.allow_non_finite)
        for board in boards
        if (name := envelopes.endpoints[board.name]) in of_envelope
    }


def _limits(table: RouteTable, envelopes: Envelopes, envelope: Envelope, lock: LockComparison) -> BoardLimits:
    """Return the limits of boards that get this one of the envelopes and allow finite numbers only."""
    schema = envelope.schema
    fields = board_fields(schema.descriptor(envelope.name), schema.board_options, envelope.choice.root)
    named = {route.case.value for route in table.routes}
    named |= {service.request.case.value for service in table.services.values()}
    named |= {service.reply.case.value for service in table.called.values()}
    named |= {payload.case.value for route in table.routes if route.deadman for payload in route.deadman.payloads}
    named |= {route.reply.case.value for route in table.routes if route.reply}
    types = {case.type.name for table_case in named if (case := envelopes.cases.get(table_case)) is not None}
    cases = [case for case in envelope.cases.values() if case.type.name in types]
    longest, payloads = lock.max_size or envelope.max_size, payload_fields(envelope, cases, schema.board_options)
    return BoardLimits(fields, longest, allows_non_finite=False, payloads=payloads)


def _board_findings(table: RouteTable, boards: Mapping[str, BoardLimits]) -> Iterator[Diagnostic]:
    counted = {id(limits.fields): limits.fields for limits in boards.values()}  # boards share the fields
    sizes = {key: places(fields) for key, fields in counted.items()}
    for name, limits in boards.items():
        messages, lists = sizes[id(limits.fields)]
        if messages > MOST_MESSAGES or lists > MOST_LISTS:
            what = f"the envelope for '{name}' has {messages:,} nested messages and {lists:,} repeated fields"
            hint = f"the limits are {MOST_MESSAGES:,} and {MOST_LISTS:,}: make it another kind of endpoint"
            yield Diagnostic(table.endpoints[name].span, Code.TOO_LARGE, what, hint)


def _envelope_findings(lookup: Lookup, routes: Iterable[CheckedRoute]) -> Iterator[Diagnostic]:
    """Yield findings for fields beside the payload that nothing fills in envelopes that the router makes.

    It makes them from messages from ROS, for deadmen and as replies; forwarded ones keep their fields.
    """
    table = lookup.table
    for name in dict.fromkeys(name for checked in routes for name in _made_for(checked)):
        endpoint = table.endpoints.get(name)
        if endpoint is None or (endpoint.beside and name not in lookup.beside):
            continue  # or `set` has findings already
        envelope, settings = lookup.envelopes.to(name), table.envelopes.get(lookup.envelopes.endpoints[name])
        if settings is None:
            continue  # the table has no such envelope
        empty = unfilled(envelope.beside, lookup.beside.get(name))
        for required in (member.name for member in empty if member.is_required):
            message = f"nothing fills '{required}', which {envelope.name} requires, in envelopes for '{name}'"
            declared = envelope.schema.span(envelope.name, required)
            hint = f"see {declared}; write `set: {{{required}: VALUE}}` in the endpoint"
            yield Diagnostic(endpoint.span, Code.MISSING_KEY, message, hint)
        names = [member.name for member in empty if not member.is_required]
        if endpoint.kind is EndpointKind.BOARD and names and settings.because is None:
            made = f"envelopes that the router makes for '{name}'"
            what = f"nothing fills {', '.join(names)} of {envelope.name} in {made}"
            more = ", ..." * (len(names) > 1)
            hint = f"write `set: {{{names[0]}: VALUE{more}}}` in the endpoint, or `because: why` in 'envelope'"
            yield Diagnostic(endpoint.span, Code.EMPTY_FIELD, what, hint)


def _unused_sets(lookup: Lookup, routes: Iterable[CheckedRoute]) -> Iterator[Diagnostic]:
    """Yield findings for `set` of endpoints for which the router makes no envelopes, unless the table has errors."""
    if lookup.table.broken or _has_errors(lookup.findings):
        return
    made = {name for checked in routes for name in _made_for(checked)}
    made |= {service.request.to.value for service in lookup.table.services.values()}
    for endpoint in lookup.table.endpoints.values():
        if endpoint.beside is not None and endpoint.name not in made:
            what = f"'set' of '{endpoint.name}' fills nothing: the router makes no message for it"
            hint = "remove 'set'; what is forwarded keeps its own fields"
            yield Diagnostic(endpoint.beside.span, Code.UNUSED_SET, what, hint)


def _made_for(checked: CheckedRoute) -> Iterator[str]:
    """Yield the endpoints to which a route sends envelopes that the router makes."""
    yield from (target.label for target in checked.targets if target.rewrapped)
    yield from (target.label for target in checked.targets if target.reply is not None)
    yield from (target.label for subscription in checked.subscriptions for target in subscription.targets)
    yield from (name for name, _ in (checked.deadman.datagrams if checked.deadman else ()))


def _envelopes(table: RouteTable, definitions: Definitions) -> Envelopes:
    """Return the envelopes of the table. Raises TableError."""
    chosen = {
        name: chosen_envelope(definitions.protos(settings), settings.choice)
        for name, settings in table.envelopes.items()
    }
    if alike := written_alike(chosen):
        label, name = alike
        message, hint = f"two payload cases would be written '{name}'", f"give '{label}' another name"
        raise TableError.of(table.envelopes[label].message.span, Code.BAD_VALUE, message, hint)
    return Envelopes(told_apart(chosen) or {"": no_envelope()}, *table.envelope_names)

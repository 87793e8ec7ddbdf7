"""Checks services: each is a route from ROS, which sends its requests, and a target of the route of its replies.

In the carrier, request and response are messages with a number before them: of a request, the number of the call, and
of a response, the value of `match`. It takes eight bytes, so whatever follows keeps its layout.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from router.compiler.checked import CheckedRoute, CheckedService, CheckedSubscription, Target
from router.compiler.compiled_table import MOST_CALLS, OUTCOMES, service_label
from router.compiler.constants import cdr_of
from router.compiler.conversion import convert
from router.compiler.expressions import Scope
from router.compiler.expressions.kinds import IntKind, StringKind
from router.compiler.expressions.scope import field_of
from router.compiler.expressions.tree import ENVELOPE, Constant, Node, Read, Variable
from router.compiler.lookup import Lookup
from router.compiler.mapping import FieldMapping, Row, build
from router.compiler.plan import Plan, Record, Unset
from router.compiler.routes import destinations, subscription
from router.compiler.topics import resolved
from router.errors import Code, Diagnostic, FindingError, Located, SourceSpan, TableError, did_you_mean
from router.table.model.endpoints import EndpointKind
from router.table.model.routes import ANY, Route
from router.table.model.services import Service
from router.table.model.targets import Destination, Topic
from router.table.units import duration
from router.types.model import Field, Int, MessageType
from router.types.protobuf import PayloadCase

SEQUENCE, REASON = "sequence", "reason"
"""Names in `fields` of a request, and in `on_timeout`."""

_NOTHING = MessageType("nothing")


def check_services(
    lookup: Lookup, routes: Sequence[CheckedRoute]
) -> tuple[tuple[CheckedService, ...], tuple[CheckedRoute, ...]]:
    """Check the services of the table. Return them, and all routes with theirs; findings go to `lookup`."""
    services: list[CheckedService] = []
    all_routes = list(routes)
    for declared in lookup.table.services.values():
        if (checked := _checked(lookup, declared)) is None:
            continue
        service, reply = checked
        services.append(service)
        all_routes.append(service.request)
        sender = declared.reply.sender or declared.request.to
        add_target(lookup, all_routes, declared.reply.case, service.reply_case, sender, reply)
    lookup.findings += [*_ambiguous(services), *_alike(services)]
    return tuple(services), tuple(all_routes)


def _checked(lookup: Lookup, declared: Service) -> tuple[CheckedService, Target] | None:
    request_case, reply_case = lookup.case(declared.request.case), lookup.case(declared.reply.case)
    endpoints = [lookup.endpoint(name) for name in filter(None, (declared.request.to, declared.reply.sender))]
    if request_case is None or reply_case is None or None in endpoints:
        return None
    lookup.require_listener(reply_case, declared.reply.sender or declared.request.to)
    halves = service_type(lookup, declared.type)
    if halves is None:
        return None
    lookup.findings += [*_age_findings(lookup, declared), *_brake_findings(lookup, declared)]
    request = _request(lookup, declared, request_case, halves[0])
    match = _match(lookup, declared, reply_case)
    if match is not None:
        lookup.findings += _match_findings(lookup, declared, request, match)
    reply = _reply(lookup, declared, reply_case, halves[1], match)
    responses = _responses(lookup, declared, halves[1])
    if declared.reply.match is not None and match is None:
        return None
    path = _path(match) if match is not None else None
    name = resolved(declared.name, lookup.table.node)
    most = _most_calls(lookup, declared, request)
    return CheckedService(declared, name, *halves, request, reply_case, path, most, responses), reply


def service_type(lookup: Lookup, name: Located[str]) -> tuple[MessageType, MessageType] | None:
    """Return the request and the response of a service type, or None with a finding."""
    interfaces = lookup.definitions.interfaces
    try:
        halves = interfaces.service(name.value)
    except TableError as error:
        lookup.findings += error.diagnostics
        return None
    if halves is None and "/msg/" in name.value:
        message, hint = f"'{name.value}' is a message, not a service", "write a type such as std_srvs/srv/SetBool"
        lookup.report(name.span, Code.UNKNOWN_ROS_TYPE, message, hint)
    elif halves is None:
        hint = did_you_mean(name.value, interfaces.services())
        lookup.report(name.span, Code.UNKNOWN_ROS_TYPE, f"there is no ROS service type '{name.value}'", hint)
    return halves


# requests


def _request(lookup: Lookup, declared: Service, case: PayloadCase, message: MessageType) -> CheckedRoute:
    """Return the route of the requests, whose topic is the service."""
    asked, label = declared.request, service_label(declared.name)
    topic = Topic(Located(label, declared.span), declared.span, type=Located(message.name, declared.type.span))
    route = Route(
        name=label,
        span=asked.span,
        case=asked.case,
        source_topics=(topic,),
        destinations=(Destination(asked.to, asked.to.span),),
        fields=asked.fields,
        ttl=asked.ttl,
        no_ttl=asked.no_ttl,
    )
    numbered = _numbered(message, Int(64, signed=False))
    names = {SEQUENCE: _sequence(numbered, declared.span)}
    return CheckedRoute(route, case, subscriptions=feeds(lookup, route, case, message, numbered, names))


def feeds(
    lookup: Lookup,
    route: Route,
    case: PayloadCase,
    message: MessageType,
    numbered: MessageType,
    names: Mapping[str, Node],
) -> tuple[CheckedSubscription, ...]:
    """Check the messages that a service sends to its endpoint. They feed no deadman, and never wait."""
    before, (topic,) = len(lookup.findings), route.source_topics
    recipients = destinations(lookup, route, case)
    feed = subscription(lookup, CheckedRoute(route, case), topic, message, recipients, numbered, names)
    if not message.fields:  # then nothing can fill the payload
        lookup.findings[before:] = [each for each in lookup.findings[before:] if each.code is not Code.NOTHING_MAPPED]
    if feed is None:
        return ()
    return (replace(feed, targets=tuple(replace(each, deadmen=(), is_request=True) for each in feed.targets)),)


def _sequence(numbered: MessageType, span: SourceSpan) -> Node:
    scope = Scope(numbered, (), ())
    return replace(field_of(scope.whole_message(span), numbered.fields[0], span), kind=IntKind(1, MOST_CALLS))


def _most_calls(lookup: Lookup, declared: Service, request: CheckedRoute) -> int:
    """Return the largest number of a call that the board can store in each field that `sequence` fills."""
    limits, most = lookup.boards.get(declared.request.to.value), MOST_CALLS
    if limits is None:
        return most
    for target in (target for feed in request.subscriptions for target in feed.targets):
        for row in target.rows:
            stored = limits.integers(request.case, row.target.split(".")) if row.expression == SEQUENCE else None
            most = min(most, stored.high) if stored is not None else most
    return most


def _numbered(message: MessageType, number: Int) -> MessageType:
    """Return the message with a number before it. Its name is no name of a field, so expressions cannot read it."""
    return behind(message, Field("(number)", number))


def behind(message: MessageType, *first: Field) -> MessageType:
    """Return the message with other fields before its own."""
    fields = message.fields or (Field("structure_needs_at_least_one_member", Int(8, signed=False)),)
    return MessageType(message.name, (*first, *fields), message.constants)


def _age_findings(lookup: Lookup, declared: Service) -> Iterator[Diagnostic]:
    asked = declared.request
    if asked.to.value in lookup.boards and asked.ttl is None and asked.no_ttl is None:
        message = f"calls that waited in a queue or a stopped process still command '{asked.to.value}'"
        yield Diagnostic(asked.span, Code.NO_TTL, message, "add `ttl: 200ms`, or `ttl: {none: why}`")


def _brake_findings(lookup: Lookup, declared: Service) -> Iterator[Diagnostic]:
    """Yield a warning if the board is stopped by a deadman, which does not know of calls."""
    to = declared.request.to.value
    endpoint = lookup.table.endpoints.get(to)
    if declared.because is not None or endpoint is None or endpoint.kind is not EndpointKind.BOARD:
        return
    for route in lookup.table.routes:
        if route.deadman is not None and to in [each.value for each in route.deadman.to]:
            message = (
                f"calls command '{to}', but they do not feed the deadman of '{route.name}', which stops this board: "
                "it does not stop what a call begins"
            )
            hint = "if a call moves nothing, add `because: why`; commands that move something need a route"
            yield Diagnostic(declared.request.to.span, Code.DOUBTFUL_DEADMAN, message, hint)
            return


# replies


def _match(lookup: Lookup, declared: Service, case: PayloadCase) -> Node | None:
    """Return the field of the reply that `match` names; None without one, or with a finding."""
    expression = declared.reply.match
    if expression is None:
        return None
    wanted, hint = "'match' takes an integer field", "name one, such as envelope.req_id"
    node = lookup.value(expression, lookup.received(case), (IntKind,), wanted, hint)
    if node is not None and _path(node) is None:
        message = "'match' takes a field of the envelope or of the payload, which request and reply have in common"
        lookup.report(node.span, Code.BAD_VALUE, message, hint)
        return None
    return node


def _path(node: Node) -> tuple[str, ...] | None:
    """Return the names of a field, with ENVELOPE before those of the envelope; None for anything else."""
    if isinstance(node, Variable):
        return (ENVELOPE,) if node.name == ENVELOPE else ()
    around = _path(node.holder) if isinstance(node, Read) else None
    return (*around, node.field.name) if around is not None and isinstance(node, Read) else None


def _match_findings(lookup: Lookup, declared: Service, request: CheckedRoute, match: Node) -> Iterator[Diagnostic]:
    """Yield a finding if a request does not have a number of its own in the field that `match` names."""
    path, to = _path(match) or (), declared.request.to.value
    name = ".".join(path)
    if path[:1] == (ENVELOPE,):
        rows: Sequence[Row] = lookup.beside[to].rows if to in lookup.beside else ()
        hint = f"write `set: {{{'.'.join(path[1:])}: {SEQUENCE}}}` in the endpoint '{to}'"
        endpoint = lookup.table.endpoints.get(to)
        is_known = endpoint is not None and (endpoint.beside is None or to in lookup.beside)
    else:
        targets = [target for feed in request.subscriptions for target in feed.targets]
        rows = [row for target in targets for row in target.rows]
        hint = f"fill it in 'fields' of the request, for example `{name}: {SEQUENCE}`"
        is_known = bool(targets)
        if _field(request.case.type, path) is None:
            message = f"'{request.case.name}' has no integer field '{name}' to compare with that of the reply"
            yield Diagnostic(match.span, Code.UNKNOWN_FIELD, message, "both need a field of this name")
            return
    what = _why_alike(next((row for row in rows if row.target == name), None))
    if is_known and what:  # otherwise there is a finding already
        message = f"{what} '{name}' in the requests, so replies cannot be told apart"
        yield Diagnostic(match.span, Code.BAD_VALUE, message, hint)


def _why_alike(filling: Row | None) -> str:
    """Return why a field has the same value in all requests; empty if it does not."""
    if filling is None:
        return "nothing fills"
    is_constant = filling.kind.startswith("int ") and ".." not in filling.kind
    return "the same value fills" if is_constant else ""


def _field(message: MessageType, path: Sequence[str]) -> Field | None:
    """Return the integer field at a path, None if there is none."""
    found = None
    for name in path:
        found = message.field(name)
        if found is None:
            return None
        message = found.type if isinstance(found.type, MessageType) else _NOTHING
    return found if found is not None and isinstance(found.type, Int) else None


def _reply(lookup: Lookup, declared: Service, case: PayloadCase, message: MessageType, match: Node | None) -> Target:
    """Return the target that gets the replies: the response, after the value of `match`."""
    label, reply = service_label(declared.name), declared.reply
    sources = (reply.sender or declared.request.to,)
    scope = lookup.received(case, message, route=Route(label, reply.span, reply.case, sources=sources))
    mapping = _mapped(build(reply.fields, message, scope, reply.span, None, message), message)
    lookup.findings += mapping.findings
    number = Int(64, signed=isinstance(match, Read) and isinstance(match.kind, IntKind) and match.kind.low < 0)
    numbered = _numbered(message, number)
    leading: Plan = convert(match, number, scope) if match is not None else Unset(number, None, reply.span)
    fillers = mapping.plan.members or ((numbered.fields[1], Unset(numbered.fields[1].type, None, reply.span)),)
    plan = Record(numbered, ((numbered.fields[0], leading), *fillers), reply.span)
    topic = Topic(Located(label, reply.span), reply.span, type=Located(message.name, declared.type.span))
    return Target(topic, type=message, plan=plan, rows=tuple(mapping.rows))


def _mapped(mapping: FieldMapping, message: MessageType) -> FieldMapping:
    """Return the mapping; a response without fields needs none."""
    return mapping if message.fields else replace(mapping, findings=[])


def add_target(
    lookup: Lookup,
    routes: list[CheckedRoute],
    named: Located[str],
    case: PayloadCase,
    sender: Located[str],
    target: Target,
) -> None:
    """Add a service as the target of messages of a case to the route that takes them, or add a route."""
    for index, checked in enumerate(routes):
        route, taken = checked.route, [source.value for source in checked.route.sources]
        if checked.case.name != case.name or checked.subscriptions:
            continue
        if (clash := _clash(route, case.name, sender.value)) is not None:
            code, message, hint = clash
            lookup.report(named.span, code, message, f"{hint}: see {route.span}")
            return
        if taken == [sender.value]:
            routes[index] = replace(checked, targets=(*checked.targets, target))
            return
    names = {each.route.name for each in routes}
    name = case.name if case.name not in names else f"{case.name}_from_{sender.value}"
    route = Route(name=name, span=target.span, case=named, sources=(sender,))
    routes.append(CheckedRoute(route, case, (target,)))


def _clash(route: Route, case: str, sender: str) -> tuple[Code, str, str] | None:
    """Return why a route keeps a service from getting messages of a case from `sender`, and the remedy; else None."""
    taken = [source.value for source in route.sources]
    if route.ignore is not None:
        return Code.BAD_VALUE, f"'{case}' is ignored, so the service does not get it", "remove `ignore`"
    if sender not in taken and ANY not in taken:
        return None
    if taken != [sender]:
        hint = f"write a list of routes, one of them only from '{sender}'"
        return Code.SOURCE_CLASH, f"a route takes '{case}' from '{sender}' and others", hint
    if route.collect is not None:
        message = f"a route collects '{case}' from '{sender}' into frames, so the service does not get it alone"
        return Code.SOURCE_CLASH, message, "remove `collect`"
    return None


def _ambiguous(services: Iterable[CheckedService]) -> Iterator[Diagnostic]:
    """Yield a finding for each service whose replies may be those of another one."""
    groups: dict[tuple[str, str], list[CheckedService]] = {}
    for service in services:
        groups.setdefault(service.group, []).append(service)
    for (case, sender), several in groups.items():
        for service in several[1:]:
            if service.match is None or service.match != several[0].match:
                message = f"'{case}' from '{sender}' also answers '{several[0].declared.name}'"
                hint = "give both services the same `match`, so that their replies can be told apart"
                yield Diagnostic(service.declared.reply.span, Code.BAD_VALUE, message, hint)


def _alike(services: Iterable[CheckedService]) -> Iterator[Diagnostic]:
    """Yield a finding for each service that has the name of another one in ROS."""
    named: dict[str, CheckedService] = {}
    for service in services:
        other = named.setdefault(service.ros_name, service).declared
        if other is not service.declared:
            message = f"'{service.declared.name}' and '{other.name}' are the same service in ROS, {service.ros_name}"
            hint = f"remove one, for each call would get two responses: see {other.span}"
            yield Diagnostic(service.declared.span, Code.BAD_VALUE, message, hint)


# responses that the router gives itself


def _responses(lookup: Lookup, declared: Service, message: MessageType) -> Mapping[str, bytes]:
    """Return the response for each outcome but a reply."""
    texts = {
        outcome: text.format(endpoint=declared.request.to.value, timeout=duration(declared.timeout.value))
        for outcome, text in OUTCOMES.items()
    }
    responses: dict[str, bytes] = {}
    for outcome, text in texts.items():
        names = {REASON: Constant(StringKind(), declared.span, text)}
        scope = replace(lookup.scope(_NOTHING, message, names), given=())
        mapping = build(declared.on_timeout, message, scope, declared.on_timeout.span)
        findings = [each for each in mapping.findings if each.code is not Code.NOTHING_MAPPED]
        if findings:  # the same for each outcome
            lookup.findings += findings
            return {}
        try:
            responses[outcome] = cdr_of(mapping.plan)
        except FindingError as error:
            lookup.findings.append(error.diagnostic)
            return {}
    return responses

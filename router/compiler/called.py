"""Checks services that endpoints call: each is a target of the route of the messages that call it, and a route of its
replies, with a topic for responses and one for what is sent without a response.

In the carrier, the numbers of the message that calls precede the request, the response, and the reason why there is
none: `request.NAME` reads them there. Each takes eight bytes, so whatever follows keeps its layout.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from router.compiler.checked import CheckedCalled, CheckedRoute, CheckedSubscription, Target
from router.compiler.compiled_table import service_label
from router.compiler.conversion import convert
from router.compiler.expressions import Scope
from router.compiler.expressions.scope import field_of
from router.compiler.lookup import Lookup
from router.compiler.mapping import build
from router.compiler.plan import Plan, Record, Unset
from router.compiler.services import add_target, behind, feeds, service_type
from router.compiler.topics import resolved
from router.errors import Code, Diagnostic, Located, SourceSpan
from router.table.model.expressions import FieldMap
from router.table.model.routes import Route
from router.table.model.services import CalledService
from router.table.model.targets import Destination, Topic
from router.types.model import Bool, Enum, Field, Float, Int, List, MessageType, String
from router.types.protobuf import PayloadCase

REQUEST, REASON = "request", "reason"
"""Names in `fields` of a reply and in `on_timeout`, and in the latter."""

UNANSWERED = MessageType("a call without a response", (Field(REASON, String()),))
"""What `on_timeout` is filled from, besides the kept values."""

_PLACE = 8
"""Bytes of a value that is kept."""


def check_called(
    lookup: Lookup, routes: Sequence[CheckedRoute]
) -> tuple[tuple[CheckedCalled, ...], tuple[CheckedRoute, ...]]:
    """Check the services that endpoints call. Return them, and all routes with theirs; findings go to `lookup`."""
    services: list[CheckedCalled] = []
    all_routes = list(routes)
    for declared in lookup.table.called.values():
        source, reply = lookup.case(declared.source.case), lookup.case(declared.reply.case)
        endpoint = lookup.endpoint(declared.source.source)
        halves = service_type(lookup, declared.call.type)
        if source is None or reply is None or endpoint is None or halves is None:
            continue
        lookup.require_listener(source, declared.source.source)
        kept = _kept(source)
        services.append(CheckedCalled(declared, *halves, _PLACE * _places(kept)))
        target = _request(lookup, declared, source, halves[0], kept)
        add_target(lookup, all_routes, declared.source.case, source, declared.source.source, target)
        all_routes.append(_replies(lookup, declared, reply, halves[1], kept))
    lookup.findings += _type_clashes(lookup)
    return tuple(services), tuple(all_routes)


def _type_clashes(lookup: Lookup) -> Iterator[Diagnostic]:
    """Yield a finding for each service that is called with another type than elsewhere in the table."""
    table = lookup.table
    types = {resolved(each.name, table.node): each.type for each in table.services.values()}
    called = [(each.call.service.value, each.call.type) for each in table.called.values()]
    called += [(each.service.value, each.type) for gateway in table.gateways.values() for each in gateway.calls]
    for service, type_ in called:
        other = types.setdefault(resolved(service, table.node), type_)
        if other.value != type_.value:
            message = f"'{service}' has the type {type_.value} here, but {other.value} elsewhere"
            hint = f"a service has one type in ROS: see {other.span}"
            yield Diagnostic(type_.span, Code.TOPIC_TYPE_CLASH, message, hint)


# values that are kept


def _kept(case: PayloadCase) -> MessageType:
    """Return the type of the values that are kept of a message: its numbers, bools and enums."""
    fields: list[Field] = []
    for member in case.type.fields:
        declared = Int(32, signed=True) if isinstance(member.type, Enum) else member.type
        if isinstance(declared, (Bool, Int, Float)):
            fields.append(Field(member.name, declared))
            size = 1 if isinstance(declared, Bool) else declared.bits // 8
            if size < _PLACE:
                fields.append(Field(f"({member.name})", List(Int(8, signed=False), length=_PLACE - size)))
    return MessageType(
        f"what is kept of {case.type.name}", tuple(fields) or (Field("(nothing)", Int(64, signed=False)),)
    )


def _places(kept: MessageType) -> int:
    return sum(not isinstance(member.type, List) for member in kept.fields)


def _keeping(kept: MessageType, case: PayloadCase, scope: Scope, span: SourceSpan) -> Record:
    """Return the plan that keeps the values of a message."""
    members: list[tuple[Field, Plan]] = []
    for member in kept.fields:
        source = case.type.field(member.name)
        if source is None:
            members.append((member, Unset(member.type, None, span)))
        else:
            members.append((member, convert(field_of(scope.whole_message(span), source, span), member.type, scope)))
    return Record(kept, tuple(members), span)


# requests and replies


def _request(
    lookup: Lookup, declared: CalledService, case: PayloadCase, message: MessageType, kept: MessageType
) -> Target:
    """Return the target that gets the messages that call: the request, after what is kept."""
    call, label = declared.call, service_label(declared.name)
    route = Route(label, call.span, declared.source.case, sources=(declared.source.source,))
    scope = lookup.received(case, message, route=route)
    mapping = build(call.fields, message, scope, call.span, None, message)
    if message.fields:
        lookup.findings += mapping.findings
    whole = behind(message, Field("(kept)", kept))
    first = _keeping(kept, case, scope, call.span)
    fillers = mapping.plan.members or ((whole.fields[1], Unset(whole.fields[1].type, None, call.span)),)
    plan = Record(whole, ((whole.fields[0], first), *fillers), call.span)
    topic = Topic(Located(label, call.span), call.span, type=Located(message.name, call.type.span))
    return Target(topic, type=message, plan=plan, rows=tuple(mapping.rows))


def _replies(
    lookup: Lookup, declared: CalledService, case: PayloadCase, response: MessageType, kept: MessageType
) -> CheckedRoute:
    """Return the route of the replies: responses, and reasons why there are none."""
    label, reply = service_label(declared.name), declared.reply
    found: list[CheckedSubscription] = []
    for name, fields, message in (
        (label, reply.fields, response),
        (f"{label}.on_timeout", declared.on_timeout, UNANSWERED),
    ):
        topic = Topic(Located(name, reply.span), reply.span, type=Located(response.name, declared.call.type.span))
        found += _feeds(lookup, declared, case, topic, fields, message, kept)
    route = _route(declared, label, tuple(feed.topic for feed in found))
    return CheckedRoute(route, case, subscriptions=tuple(found))


def _feeds(
    lookup: Lookup,
    declared: CalledService,
    case: PayloadCase,
    topic: Topic,
    fields: FieldMap | None,
    message: MessageType,
    kept: MessageType,
) -> Sequence[CheckedSubscription]:
    route = replace(_route(declared, service_label(declared.name), (topic,)), fields=fields)
    whole = behind(message, Field("(kept)", kept))
    span, before = declared.reply.span, len(lookup.findings)
    names = {REQUEST: field_of(Scope(whole, (), ()).whole_message(span), whole.fields[0], span)}
    found = feeds(lookup, route, case, message, whole, names)
    if message.field(REASON) is not None and fields is not None and not fields.entries:
        lookup.findings[before:] = [each for each in lookup.findings[before:] if each.code is not Code.NOTHING_MAPPED]
    return found


def _route(declared: CalledService, label: str, topics: tuple[Topic, ...]) -> Route:
    to = declared.source.source
    return Route(
        name=label,
        span=declared.reply.span,
        case=declared.reply.case,
        source_topics=topics,
        destinations=(Destination(to, to.span),),
    )

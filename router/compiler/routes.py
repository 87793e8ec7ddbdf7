"""Checks routes: resolves every name, types every mapping, and collects all findings."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from router.compiler.checked import CheckedCollect, CheckedOrder, CheckedRoute, CheckedSubscription, Target
from router.compiler.deadmen import check_deadman
from router.compiler.expressions import Scope
from router.compiler.expressions.kinds import UINT32, BoolKind, EnumKind, IntKind, ListKind, MessageKind, StringKind
from router.compiler.expressions.lists import as_value
from router.compiler.expressions.tree import COUNT, ENVELOPE, INDEX, ITEM, ITEMS, Node, Read, Variable, constant_of
from router.compiler.feeds import deadmen_of
from router.compiler.lookup import NO_NAMES, Lookup, Recipient
from router.compiler.mapping import build
from router.compiler.obeyed import check_obeyed
from router.compiler.replies import check_reply
from router.compiler.states import sets_state
from router.compiler.topics import qos_findings, resolved, stamp_of, topic_name_finding
from router.errors import Code, Diagnostic, Located, SourceSpan, nearest
from router.table.keys import are_same
from router.table.model import RouteTable
from router.table.model.expressions import Expression
from router.table.model.routes import ANY, Collect, Route
from router.table.model.targets import Destination, Topic
from router.types.model import List, MessageType
from router.types.protobuf import PayloadCase

Destinations = Sequence[tuple[Destination, "Recipient | None"]]

_OF_GAPS = frozenset({Code.NO_TARGET, Code.NOTHING_MAPPED, Code.QOS_CONFLICT, Code.NO_DEADMAN})
"""Findings that are suppressed for a route with an invalid part, which was left out and has a finding."""


def check_routes(lookup: Lookup) -> tuple[CheckedRoute, ...]:
    """Check the routes of the table. Return those whose payload case exists; findings go to `lookup`."""
    routes = tuple(checked for route in lookup.table.routes if (checked := _checked(lookup, route)))
    _coverage(lookup, {target.rewrapped.name for route in routes for target in route.all_targets if target.rewrapped})
    return routes


def _coverage(lookup: Lookup, rewrapped: Collection[str]) -> None:
    table, cases, unroutable = lookup.table, lookup.envelopes.cases, lookup.envelopes.unroutable
    names = [route.case.value for route in table.routes]
    names += [each.case.value for service in table.services.values() for each in (service.request, service.reply)]
    names += [each.case.value for service in table.called.values() for each in (service.source, service.reply)]
    # a misspelt case is one finding, not two
    covered = {name if name in cases else nearest(name, cases) for name in names if name not in unroutable}
    covered |= {name.removeprefix("routes/") for name in table.broken if name.startswith("routes/")}
    covered |= {*rewrapped}
    missing = [name for name in cases if name not in covered and name not in lookup.envelopes.parts]
    if any(name.startswith("services/") for name in table.broken):
        return  # it may cover them
    if missing and table.routes_span is not None:  # a table with only gateways has no routes
        plural = "payload case" if len(missing) == 1 else "payload cases"
        message = f"no route for the {plural} {', '.join(missing)}"
        hint = "add a route, or ignore it with `ignore: reason`"
        lookup.report(table.routes_span, Code.UNCOVERED_PAYLOAD_CASE, message, hint)


def _checked(lookup: Lookup, route: Route) -> CheckedRoute | None:
    findings = lookup.findings
    before = len(findings)
    checked = _route(lookup, route)
    findings[before:] = _without_repeats(findings[before:])
    if f"routes/{route.case.value}" in lookup.table.broken:
        findings[before:] = [finding for finding in findings[before:] if finding.code not in _OF_GAPS]
    return checked


_WITHOUT_ENVELOPE = {ENVELOPE: ("a message from ROS has no envelope", "name a field of the message")}
_NO_FOR_EACH = f"'{ITEM}', '{INDEX}' and '{COUNT}' need `for_each`, which is missing here"
_NO_COLLECT = f"'{ITEMS}' and '{COUNT}' need `collect`, which this route lacks"
_COLLECT = "add `collect: {by: FIELD, count: FIELD, order: FIELD, timeout: 1s}`"


def _without_repeats(findings: Sequence[Diagnostic]) -> Iterator[Diagnostic]:
    """Yield the findings. A missing `for_each` or `collect` is reported once, not for each name that needs it."""
    said = set()
    for finding in findings:
        if finding.message not in said:
            yield finding
        said |= {finding.message} & {_NO_FOR_EACH, _NO_COLLECT}


def _without_for_each(message: MessageType) -> dict[str, tuple[str, str]]:
    """Return the names that are missing without `for_each`, with message and hint: see `Scope.absent`."""
    lists = [member.name for member in message.fields if isinstance(member.type, List)]
    hint = " or ".join(f"`for_each: {name}`" for name in lists[:_MOST_LISTS] or ("LIST",))
    return dict.fromkeys((ITEM, INDEX, COUNT), (_NO_FOR_EACH, f"add {hint}"))


_MOST_LISTS = 4
"""Maximum number of lists that a hint offers."""


def _route(lookup: Lookup, route: Route) -> CheckedRoute | None:
    if route.ignore is not None and route.case.value in lookup.envelopes.unroutable:
        return None
    case = lookup.case(route.case)
    if case is None:
        return None
    if route.ignore is not None:
        return CheckedRoute(route, case)
    _sources(lookup, route, case)
    is_setter = any(True for _ in sets_state(lookup.table.states.values(), route))
    if not route.destinations and not route.topics and route.reply is None and not is_setter:
        places = "destinations" if route.is_outbound else "destinations or topics"
        message, hint = f"'{route.name}' has no targets", f"add {places}, or ignore it with `ignore: reason`"
        lookup.report(route.span, Code.NO_TARGET, message, hint)
    for topic in route.all_topics:
        findings = (topic_name_finding(topic), *qos_findings(topic, publishes=topic in route.topics))
        lookup.findings += [finding for finding in findings if finding]
    checked = (check_outbound if route.is_outbound else check_inbound)(lookup, route, case)
    deadman, obeyed = check_deadman(lookup, route), check_obeyed(lookup, route)
    return replace(checked, deadman=replace(deadman, obeyed=obeyed) if deadman else None)


def _sources(lookup: Lookup, route: Route, case: PayloadCase) -> None:
    seen: set[str] = set()
    for source in route.sources:
        if source.value in seen:
            lookup.report(source.span, Code.BAD_VALUE, f"'{source.value}' is a source twice", "name it once")
        seen.add(source.value)
        if source.value == ANY or lookup.endpoint(source, (ANY,)) is not None:
            lookup.require_listener(case, source)
        if source.value == ANY and len(route.sources) > 1:
            message, hint = f"'{ANY}' excludes other sources", f"write either '{ANY}' or the names of endpoints"
            lookup.report(source.span, Code.BAD_VALUE, message, hint)
    if route.sources and route.source_topics:
        message = "a route takes messages from endpoints or from topics, not from both"
        lookup.report(route.source_topics[0].span, Code.BAD_VALUE, message, "write a list of two routes")


def destinations(lookup: Lookup, route: Route, case: PayloadCase) -> Destinations:
    """Return the destinations of a route, each with what gets its payloads, or None with a finding."""
    sources = {source.value for source in route.sources}
    seen: set[str] = set()
    for destination in route.destinations:
        name = destination.endpoint
        if name.value in seen:
            lookup.report(name.span, Code.BAD_VALUE, f"'{name.value}' is a destination twice", "name it once")
        seen.add(name.value)
    return [(destination, lookup.recipient(case, destination.endpoint, sources)) for destination in route.destinations]


def _destination(
    lookup: Lookup, checked: CheckedRoute, destination: Destination, recipient: Recipient | None, scope: Scope
) -> Target:
    """Check a destination. Return it without its plan."""
    route = checked.route
    return Target(
        destination,
        endpoint=recipient.endpoint if recipient else None,
        rewrapped=recipient.case if recipient and recipient.case is not checked.case else None,
        when=lookup.when(destination.when, scope),
        declared_priority=route.priority,
        deadmen=deadmen_of(lookup, route, destination),
    )


# from UDP


def check_inbound(lookup: Lookup, route: Route, case: PayloadCase) -> CheckedRoute:
    """Check destinations, topics and `collect` of a route from UDP."""
    made = CheckedRoute(route, case)
    targets = [_forward(lookup, made, to, recipient) for to, recipient in destinations(lookup, route, case)]
    names = _frame_names(case, route.collect.span) if route.collect else {}
    for index, topic in enumerate(route.topics):
        name = topic.topic.value
        if other := next((other for other in route.topics[:index] if other.topic.value == name), None):
            hint = "name it once" if are_same(topic, other) else "give each mapping a topic of its own"
            lookup.report(topic.topic.span, Code.BAD_VALUE, f"topic '{name}' is listed twice", hint)
        ros_type = lookup.ros_type(topic)
        if ros_type is not None and (published := _publish(lookup, route, case, topic, ros_type, names)):
            targets.append(published)
    targets += check_reply(lookup, route, case)
    order = _order(lookup, case, route.order) if route.order else None
    collect = _collect(lookup, route, case, route.collect) if route.collect else None
    return replace(made, targets=tuple(targets), order=order, collect=collect)


def _forward(lookup: Lookup, checked: CheckedRoute, destination: Destination, recipient: Recipient | None) -> Target:
    if destination.fields is not None:
        message, hint = "datagrams are forwarded unchanged", "use 'fields' only for messages from a topic"
        lookup.report(destination.fields.span, Code.UNKNOWN_KEY, message, hint)
    scope = lookup.received(checked.case, route=checked.route)
    target = _destination(lookup, checked, destination, recipient, scope)
    return replace(target, beside=lookup.beside.get(target.label)) if target.rewrapped else target


def _publish(
    lookup: Lookup, route: Route, case: PayloadCase, topic: Topic, ros_type: MessageType, names: dict[str, Node]
) -> Target | None:
    """Check a topic. Return None if the type of `item` is unknown: every use would be reported."""
    scope = lookup.received(case, ros_type, names, route)
    if not names:
        scope.absent = dict.fromkeys((ITEMS, COUNT), (_NO_COLLECT, _COLLECT))
    for_each = None
    if topic.for_each is not None:
        for_each = _elements(lookup, topic.for_each, scope)
        if for_each is None:
            return None
        if _element_type(for_each) is not None and not isinstance(for_each, (Read, Variable)):
            message = f"'for_each' takes a {for_each.kind} from the datagram, not one that the table puts together"
            lookup.report(for_each.span, Code.TYPE_MISMATCH, message, "name a field that is a list of messages")
            return None
        if topic.max_rate is not None and topic.when is None:
            message = "of each list, 'max_rate' lets only the first element pass"
            hint = "select one with `when`, as in item.id == 3; or publish the list in one message, with `each`"
            lookup.report(topic.for_each.span, Code.BAD_VALUE, message, hint)
        absent = {} if names else {ITEMS: scope.absent[ITEMS]}
        scope = replace(scope, names=names | _element_names(for_each), absent=absent)
    else:
        scope.absent = {**_without_for_each(case.type), **scope.absent}
    when = lookup.when(topic.when, scope)
    whole = scope.variable(ITEM, topic.span) if for_each else None
    mapping = build(topic.fields, ros_type, scope, topic.topic.span, whole, ros_type)
    lookup.findings += mapping.findings
    return Target(topic, type=ros_type, for_each=for_each, when=when, plan=mapping.plan, rows=tuple(mapping.rows))


def _order(lookup: Lookup, case: PayloadCase, expression: Expression) -> CheckedOrder | None:
    wanted, hint = "'order' takes an integer that grows from message to message", "name one, such as envelope.seq"
    number = lookup.value(expression, lookup.received(case), (IntKind,), wanted, hint)
    if number is None or not isinstance(number.kind, IntKind):
        return None
    if constant_of(number) is not None:
        message = "'order' has the same value for all messages, so only the first one would pass"
        lookup.report(number.span, Code.BAD_VALUE, message, hint)
        return None
    low, high = number.kind.low, number.kind.high
    bits = next((bits for bits in range(1, 64) if (low, high) in _of_bits(bits)), 64)
    return CheckedOrder(number, bits, low >= 0)


def _of_bits(bits: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the ranges of an unsigned and of a signed integer."""
    return (0, (1 << bits) - 1), (-(1 << bits - 1), (1 << bits - 1) - 1)


def _frame_names(case: PayloadCase, span: SourceSpan) -> dict[str, Node]:
    """Return the names that expressions of topics can use in addition to the fields of a frame's first datagram."""
    return {
        ITEMS: Variable(ListKind(MessageKind(case.type)), span, ITEMS),
        COUNT: Variable(UINT32, span, COUNT),
    }


def _collect(lookup: Lookup, route: Route, case: PayloadCase, collect: Collect) -> CheckedCollect | None:
    if not route.topics and route.destinations:
        message = "'collect' assembles frames for topics, but this route has none"
        lookup.report(collect.span, Code.UNKNOWN_KEY, message, "remove it: destinations receive each datagram")
    scope = lookup.received(case)
    names = (IntKind, EnumKind, StringKind, BoolKind)
    by = lookup.value(collect.by, scope, names, "'by' takes an integer or a string that identifies the frame")
    count = lookup.value(collect.count, scope, (IntKind,), "'count' takes an integer")
    order = lookup.value(collect.order, scope, (IntKind,), "'order' takes an integer")
    if by is None or count is None or order is None:
        return None
    return CheckedCollect(collect.span, by, count, order)


# from ROS


def check_outbound(lookup: Lookup, route: Route, case: PayloadCase) -> CheckedRoute:
    """Check the topics of a route from ROS, and their mappings to each destination."""
    recipients = destinations(lookup, route, case)
    made, subscriptions = CheckedRoute(route, case), []
    for topic in route.source_topics:
        name = topic.topic.value
        if next(other for other in route.source_topics if other.topic.value == name) is not topic:
            lookup.report(topic.topic.span, Code.BAD_VALUE, f"topic '{name}' is listed twice", "name it once")
        ros_type = lookup.ros_type(topic)
        if ros_type is not None and (checked := subscription(lookup, made, topic, ros_type, recipients)):
            subscriptions.append(checked)
    return replace(made, subscriptions=tuple(subscriptions))


def subscription(
    lookup: Lookup,
    checked: CheckedRoute,
    topic: Topic,
    ros_type: MessageType,
    recipients: Destinations,
    numbered: MessageType | None = None,
    names: Mapping[str, Node] = NO_NAMES,
) -> CheckedSubscription | None:
    """Check a topic and its targets. Return None if the type of `item` is unknown: every use would be reported.

    Of a service, `numbered` is the request with what the router adds to it, and `names` are further variables.
    """
    route, case, message = checked.route, checked.case, numbered or ros_type
    scope = lookup.scope(message, ros_type, names)
    stamp = stamp_of(scope, topic.span) if route.ttl else None
    for_each = None
    if route.for_each is not None:
        for_each = _elements(lookup, route.for_each, scope)
        if for_each is None:
            return None
        scope = lookup.scope(ros_type, ros_type, _element_names(for_each))
        scope.absent = _WITHOUT_ENVELOPE
    else:
        scope.absent = {**_without_for_each(ros_type), **_WITHOUT_ENVELOPE}
    when = lookup.when(topic.when, scope)
    own = any(destination.fields for destination, _ in recipients)  # then the route needs no fields of its own
    targets = []
    for destination, recipient in recipients:
        fields = destination.fields or route.fields
        whole = scope.variable(ITEM, route.span) if for_each else None
        span = destination.span if own else route.span
        mapping = build(fields, case.type, scope, span, whole, _element_type(for_each) if for_each else ros_type)
        lookup.findings += mapping.findings
        target = _destination(lookup, checked, destination, recipient, scope)
        beside = lookup.beside.get(target.label)
        targets.append(replace(target, plan=mapping.plan, rows=tuple(mapping.rows), beside=beside))
    return CheckedSubscription(topic, message, when, for_each, stamp, tuple(targets))


def _element_type(elements: Node) -> MessageType | None:
    """Return the message type of the elements of `for_each`, None if they are not messages."""
    element = elements.kind.element if isinstance(elements.kind, ListKind) else None
    return element.type if isinstance(element, MessageKind) else None


def _elements(lookup: Lookup, expression: Expression, scope: Scope) -> Node | None:
    """Return the list of `for_each`, or None with a finding, also for an empty literal, whose elements have no type."""
    node = lookup.value(
        expression, scope, (ListKind,), "'for_each' takes a list", 'quote a list literal: "[left, right]"'
    )
    if node is not None and isinstance(node.kind, ListKind) and node.kind.element is None:
        lookup.report(node.span, Code.TYPE_MISMATCH, "'for_each' takes a list with elements, not an empty one")
        return None
    return as_value(node, scope) if node else None


def _element_names(elements: Node) -> dict[str, Node]:
    """Return the names that expressions can use with `for_each`, in addition to the fields of the message."""
    assert isinstance(elements.kind, ListKind)  # noqa: S101 - see _elements
    assert elements.kind.element is not None  # noqa: S101
    return {
        ITEM: Variable(elements.kind.element, elements.span, ITEM),
        INDEX: Variable(UINT32, elements.span, INDEX),
        COUNT: Variable(UINT32, elements.span, COUNT),
    }


# across routes


def clash_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for routes of one payload case with the same source."""
    earlier: dict[str, dict[str, SourceSpan]] = {}
    for route in table.routes:
        taken = earlier.setdefault(route.case.value, {})
        origins = _origins(route, table)
        for key, origin in origins.items():
            if (name := _taken(key, taken)) is not None:
                message = f"another route takes '{route.case.value}' from '{name}'"
                yield Diagnostic(
                    origin.span,
                    Code.SOURCE_CLASH,
                    message,
                    f"see {taken[name]}; remove the source from one of the routes",
                )
        taken.update((key, origin.span) for key, origin in origins.items())


def _origins(route: Route, table: RouteTable) -> dict[str, Located[str]]:
    """Return the sources of a route: topics by absolute name, which begins with `/`, or endpoints."""
    if route.is_outbound:
        return {resolved(topic.topic.value, table.node): topic.topic for topic in route.source_topics}
    return {source.value: source for source in route.sources}


def _taken(key: str, taken: Mapping[str, SourceSpan]) -> str | None:
    """Return the entry of `taken` that clashes with `key`, or None. `any` clashes with all endpoints."""
    if key in taken:
        return key
    if key == ANY:
        return next((name for name in taken if not name.startswith("/")), None)
    return ANY if ANY in taken and not key.startswith("/") else None

"""The output of `router explain`: routes and gateways as the router understands them, and two tables compared."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from time import sleep
from typing import TYPE_CHECKING

from router.compiler import Checked
from router.compiler.cdr import message_size
from router.compiler.checked import CheckedCalled, CheckedRoute, CheckedService, CheckedState, Target
from router.compiler.compiled_table import CompiledTable, GatewayPlan, InboundPlan, is_service, service_label
from router.compiler.expressions.tree import ENVELOPE
from router.compiler.mapping import Row
from router.compiler.metrics import PUBLISHER, SUBSCRIBER
from router.compiler.network import takes_from
from router.compiler.plan import Each, Items, Plan, Record, Unset
from router.compiler.resolution import sender_in_tests, with_stand_ins
from router.compiler.selection import TopicSelector
from router.compiler.states import sets_state, states_read
from router.compiler.topics import qos_of, resolved
from router.datagrams import Peer, Wire
from router.errors import ConfigurationError, UsageError, plural, shown_path
from router.gateway.publishers import by_frequency
from router.hosts import LOOPBACK, LOOPBACK_IPV6, with_port
from router.rehearsal.describing import EventDescriber
from router.rehearsal.fields import shown
from router.rehearsal.rehearsal import Received, Rehearsal
from router.ros.environment import check_environment, ros_remedy
from router.table.keys import flat, phrases
from router.table.model import RouteTable
from router.table.model.gateways import (
    EACH,
    Gateway,
    GatewayFormat,
    IgnoredGateway,
    TopicPattern,
    Transport,
    ZenohSettings,
)
from router.table.model.routes import ANY, ROS, Route
from router.table.model.state import State
from router.table.model.targets import OnLimit, Topic
from router.table.units import duration
from router.types.board_limits import BoardField, BoardLimits, BoardMessage
from router.types.protobuf import PayloadCase
from router.values.reading import payload

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.graph import Mistyped

_WIDEST_CELL = 48
_LONGEST_NUMBER = 64
"""Bits of an integer."""

# Routes


def explained_route(checked: CheckedRoute, everything: Checked) -> Iterator[str]:
    route, case, table, envelopes = checked.route, checked.case, everything.table, everything.envelopes
    assert table is not None  # noqa: S101 - a table without errors is one
    assert envelopes is not None  # noqa: S101 - and has envelopes
    envelope = envelopes.of(route.case.value)
    yield f"{route.name}: {case.type.name}, {envelope.choice.place(envelope.name, case)}  ({route.span})"
    if case.max_size is not None:
        inside = f", {case.max_frame} in its envelope" if case.wrapping.tag else ""
        yield f"  largest encoding: {case.max_size} bytes{inside}"
    else:
        yield f"  largest encoding: none, because {envelope.schema.unbounded(case.type.name)}"
    if route.ignore is not None:
        yield f"  ignored: {route.ignore}"
        return
    yield f"  source: {', '.join(_source(source.value, table) for source in route.sources) or ROS}"
    yield from _settings(checked)
    for state in sets_state(table.states.values(), route):
        yield f"  sets {_set(state, route)}  ({state.span})"
    for served in checked.targets:
        yield ""
        if served.topic:
            yield from _topic(served, served.topic, route)
        else:
            yield from _destination(served, checked, everything, "unchanged")
    for feed in checked.subscriptions:
        yield ""
        origin = feed.topic.topic.value
        yield f"  from {_named(origin)}: {feed.type}  ({feed.topic.span})"
        if not is_service(origin):
            yield _quality(feed.topic)
        if feed.topic.when is not None:
            yield f"    when {feed.topic.when.text}"
        for served in feed.targets:
            yield ""
            yield from _destination(served, checked, everything, f"from {_named(origin)}")


def tried_route(
    checked: CheckedRoute, everything: Checked, program: CompiledTable, words: Sequence[str]
) -> Iterator[str]:
    """Yield what happens to a payload of `field=value` words, sent by the first source to a newly started router.

    Raises UsageError for a route that takes no datagrams, and for words that do not fit.
    """
    route, case, wire = checked.route, checked.case, Wire(program.envelopes)
    if not route.sources:
        raise UsageError(f"{route.name} has no 'source'", "--given is for routes that take datagrams")
    message, source = payload(case, words), route.sources[0].value
    program = with_stand_ins(program)
    rehearsal = Rehearsal(program)
    rehearsal.datagram(*_arrival(program, source, case), wire.encode(case, message))
    yield ""
    yield f"  given {shown(case.type, message)} from {source}:"
    happened = [event for event in rehearsal.events if not isinstance(event, Received)]
    yield from (f"    {line}" for line in EventDescriber(everything, program).lines(happened))


def _settings(checked: CheckedRoute) -> Iterator[str]:
    """Yield settings of the whole route."""
    route, deadman = checked.route, checked.deadman
    if route.for_each is not None:
        yield f"  one datagram for each of {route.for_each.text}"
    if route.order is not None and checked.order is not None:
        wraps = f", which wraps around after {checked.order.bits} bits" if checked.order.bits < _LONGEST_NUMBER else ""
        yield f"  in the order of {route.order.text}{wraps}; what is not newer is dropped as out_of_order"
    if route.collect is not None:
        collect = route.collect
        yield (
            f"  frames by {collect.by.text}, of {collect.count.text} datagrams in the order of {collect.order.text}, "
            f"complete within {duration(collect.timeout.value)}"
        )
    if deadman is not None and (settings := route.deadman) is not None:
        sent, to = ", ".join(map(str, settings.payloads)), ", ".join(to.value for to in settings.to)
        yield (
            f"  deadman: {sent} to {to} when no command came for "
            f"{duration(settings.timeout.value)}, again every {duration(settings.repeat.value)}, "
            f"{_at_start(settings.at_start)}"
        )
        if settings.obeyed is not None and deadman.obeyed is not None:
            obeyed = settings.obeyed
            yield (
                f"    obeyed when {obeyed.case.value} of {', '.join(deadman.obeyed.endpoints)} says {obeyed.when}, "
                f"within {duration(obeyed.within.value)}"
            )
        if deadman.disarmed_by:
            yield f"    disarmed by commands of {', '.join(deadman.disarmed_by)}"
    if route.no_deadman is not None:
        yield f"  no deadman: {route.no_deadman}"
    if no_ttl := phrases(route).get("no_ttl"):
        yield f"  {no_ttl}"


def _arrival(program: CompiledTable, source: str, case: PayloadCase) -> tuple[str, Peer]:
    """Return the listener that receives a payload case from a source, by default the first one, and its address."""
    table, envelopes = program.table, program.envelopes
    holding = [each for each in table.listeners.values() if envelopes.at(each.name) is envelopes.of(case.name)]
    first, *_ = listeners = holding or [*table.listeners.values()]
    if (endpoint := table.endpoints.get(source)) is None:
        return first.name, (LOOPBACK if takes_from(first, LOOPBACK) else LOOPBACK_IPV6, 0)
    peer = sender_in_tests(table, endpoint)
    if endpoint.listener is not None:
        return endpoint.listener.value, peer
    return next((each.name for each in listeners if takes_from(each, peer[0])), first.name), peer


def _set(state: State, route: Route) -> str:
    """Describe what messages of a route do to a state: `state.mode: mode, for 5 s, then MODE_MANUAL`."""
    own = {source.value for source in route.sources}
    senders = [source.value for source in state.sources if {source.value, ANY} & own]
    by = f" from {', '.join(senders)}" if own != {*senders} else ""
    return f"state.{state.name}: {state.value.text}{by}, {_validity(state)}"


def _validity(state: State) -> str:
    valid = state.valid_for.value if state.valid_for else 0
    return f"for {duration(valid)}, then {state.initial.text}" if valid else f"{state.initial.text} before the first"


def explained_state(state: CheckedState, everything: Checked) -> Iterator[str]:
    declared = state.declared
    yield f"{state.label}: {state.kind}  ({declared.span})"
    if state.feed is not None:
        yield f"  from topic {state.feed.topic.topic.value}: {state.feed.type}"
        yield _quality(state.feed.topic)
    elif state.case is not None:
        yield f"  from {state.case.name}, sent by {', '.join(source.value for source in declared.sources)}"
    yield f"  {declared.value.text}, {_validity(declared)}"
    readers = [route.route.name for route in everything.routes if declared.name in states_read(route)]
    yield f"  read by {', '.join(readers) or 'no condition'}"


def explained_service(checked: CheckedService) -> Iterator[str]:
    """Yield lines about a service that an endpoint answers. Its request and reply are among the routes."""
    declared = checked.declared
    request, reply = declared.request, declared.reply
    sender = (reply.sender or request.to).value
    yield f"service {declared.name}: {declared.type.value}, {checked.ros_name} in ROS  ({declared.span})"
    yield f"  a call sends {request.case.value} to {request.to.value}"
    which = "one at a time" if reply.match is None else f"the call with the same {reply.match.text}"
    yield f"  {reply.case.value} from {sender} answers {which}"
    again = f" after each of up to {declared.retries + 1} requests" if declared.retries else ""
    yield f"  waits {duration(declared.timeout.value)} for it{again}"
    yield f"  responds without it: {declared.on_timeout}"


def explained_called(checked: CheckedCalled, table: RouteTable) -> Iterator[str]:
    """Yield lines about a service that an endpoint calls, likewise."""
    declared = checked.declared
    source, call = declared.source, declared.call
    name = resolved(call.service.value, table.node)
    yield f"service {declared.name}: {call.type.value}, {name} in ROS  ({declared.span})"
    yield f"  {source.case.value} from {source.source.value} calls it"
    yield f"  the response is sent as {declared.reply.case.value} to {source.source.value}"
    yield f"  waits {duration(call.timeout.value)} for it"


def routes_of(service: str, routes: Iterable[CheckedRoute]) -> Iterator[CheckedRoute]:
    """Yield the routes of the requests and the replies of a service."""
    label = service_label(service)
    for route in routes:
        if route.route.name == label or label in [served.label for served in route.targets]:
            yield route


def _source(name: str, table: RouteTable) -> str:
    if name == ANY:
        return name
    endpoint = table.endpoints[name]
    address, port = endpoint.address.value.host, endpoint.source_port.value if endpoint.source_port else None
    if endpoint.address.value.is_learned:
        address += f" from port {port}" if port else ""
        address += f" in {', '.join(map(str, endpoint.networks))}" if endpoint.networks else ""
    elif port is not None:
        address = with_port(address, port)
    by = f" by listener {endpoint.listener.value}" if endpoint.listener else ""
    return f"{name} ({address}{by})"


def _destination(served: Target, checked: CheckedRoute, everything: Checked, how: str) -> Iterator[str]:
    """Yield what happens to a message for an endpoint, in this order."""
    endpoint = served.endpoint
    assert endpoint is not None  # noqa: S101 - that of a destination
    if (held := served.rewrapped) is not None and everything.envelopes is not None:
        around = everything.envelopes.to(served.label)
        how = how if served.plan else "the payload"
        how = f"{how}, as {held.name}, {around.choice.place(around.name, held)}"
    trimmed = ", trailing zeros trimmed" if endpoint.trim_trailing_zeros else ""
    what = f"destination {served.label} ({endpoint.address.value}): {how}"
    if served.reply is not None:
        what = f"reply to {served.label}, where the datagram came from: {served.reply.name}"
    yield f"  {what}{trimmed}  ({served.span})"
    yield from _conditions(served, checked.route)
    yield from _mapping(served)
    if board := everything.boards.get(served.label):
        sent = served.reply or served.rewrapped or checked.case
        yield f"    checked for the board: {', '.join(_bounds(board, sent))}"
    yield from _waiting(served)
    if others := [other for other in served.deadmen if other != checked.route.name]:
        yield f"    disarms the deadman of {', '.join(others)}"
    if checked.route.name in served.deadmen:
        yield "    feeds its own deadman" if others else "    feeds the deadman"


def _topic(served: Target, topic: Topic, route: Route) -> Iterator[str]:
    """Yield what happens to a message that is published, in this order."""
    yield f"  {_named(served.label)}: {topic.type_name}  ({served.span})"
    if not is_service(served.label):
        yield _quality(topic)
        if not qos_of(topic).serves_late_joiners:
            yield "    only while a node subscribes"
    yield from _conditions(served, route)
    yield from _mapping(served)
    if served.plan is not None and not is_service(served.label):
        size, exact = message_size(served.plan)
        yield f"    CDR: {size} bytes" if exact else f"    CDR: {size} bytes and the contents of strings and sequences"
    yield from _waiting(served)


def _conditions(served: Target, route: Route) -> Iterator[str]:
    """Yield what decides whether a target gets a message."""
    words = phrases(served.declared)
    if split := words.get("for_each"):
        yield f"    {split}"
    if when := words.get("when"):
        yield f"    {when}"
    if age := phrases(route).get("ttl"):
        yield f"    {age}"
    if "max_rate" in words and served.declared.on_limit is OnLimit.FIRST:
        yield f"    {words['max_rate']}, {words['on_limit']}"


def _waiting(served: Target) -> Iterator[str]:
    """Yield what decides when a message that is ready is sent."""
    words = phrases(served.declared)
    if "max_rate" in words and served.declared.on_limit is OnLimit.LATEST:
        yield f"    {words['max_rate']}, {words['on_limit']}"
    if served.is_deferred and served.endpoint is not None and served.endpoint.bandwidth is not None:
        yield f"    {served.priority.value} within a bandwidth of {served.endpoint.bandwidth} bytes/s"


def _bounds(board: BoardLimits, case: PayloadCase) -> Iterator[str]:
    """Yield the limits of a board's firmware."""
    yield f"at most {plural(board.longest, 'byte')}"
    fields = list(_bounded(board.payload(case)))
    names = [name for name in (case.name, case.member) if any(field.path.startswith(f"{name}.") for field in fields)]
    prefix = f"{names[0]}." if names else ""
    if any(field.is_float for field in fields):
        yield "NaN and infinity allowed" if board.allows_non_finite else "no NaN or infinity"
    held = case.wrapping.tag >> 3
    beside = [field for number, field in board.fields.items() if number != held] if held else []
    if required := [field.path.removeprefix(prefix) for field in (*fields, *beside) if field.is_required]:
        yield f"with {', '.join(required)}"
    for field in fields:
        if sizes := list(_sizes(field)):
            yield f"{field.path.removeprefix(prefix)} of {', each of '.join(sizes)}"


def _sizes(field: BoardField) -> Iterator[str]:
    if field.most is not None:
        yield _size(field.most, "element", is_fixed=field.has_fixed_count)
    if field.longest is not None:
        yield _size(field.longest, "byte", is_fixed=field.has_fixed_length)
    if field.integers is not None:
        yield f"{field.integers.low} to {field.integers.high}"


def _bounded(message: BoardMessage) -> Iterator[BoardField]:
    """Yield the fields of a message and of the messages in it."""
    for field in message.values():
        yield field
        if field.message is not None:
            yield from _bounded(field.message)


def _named(label: str) -> str:
    """Return what a target or an origin is, with its name."""
    return label if is_service(label) else f"topic {label}"


def _size(bound: int, unit: str, *, is_fixed: bool) -> str:
    return f"{plural(bound, unit)} or none" if is_fixed else f"up to {plural(bound, unit)}"


def _mapping(served: Target) -> Iterator[str]:
    """Yield one line for each mapped field, in columns, and the fields that nothing fills."""
    beside = served.beside
    yield from _rows([*served.rows, *(beside.rows if beside else ())])
    unset = [*_unset(served.plan, "")] if served.plan is not None else []
    unset += _unset(beside.plan, ENVELOPE) if beside else ()
    if unset:
        yield f"    left at their defaults: {', '.join(unset)}"


def _rows(rows: Sequence[Row]) -> Iterator[str]:
    """Yield lines in columns; a long expression shifts only the rest of its line."""
    cells = [(row.target, row.target_type, row.expression, f": {row.kind}", "auto" * row.automatic) for row in rows]
    widths = [min(max(map(len, column)), _WIDEST_CELL) for column in zip(*cells, strict=True)]
    for target, type_, expression, kind, automatic in (
        [text.ljust(width) for text, width in zip(cell, widths, strict=True)] for cell in cells
    ):
        yield f"    {target}  {type_}  <-  {expression}  {kind}  {automatic}".rstrip()


def _unset(plan: Plan, prefix: str) -> Iterator[str]:
    """Yield the fields that nothing fills; a message without any filled field counts as one."""
    match plan:
        case Unset():
            yield prefix
        case Record():
            for member, inner in plan.members:
                if member.name not in plan.type.names:  # the router adds it
                    continue
                yield from _unset(inner, f"{prefix}.{member.name}" if prefix else member.name)
        case Items():
            for index, inner in enumerate(plan.items):
                yield from _unset(inner, f"{prefix}[{index}]")
        case Each():
            yield from _unset(plan.element, f"{prefix}[]")


def _quality(topic: Topic) -> str:
    """Return a line with the whole QoS of a topic."""
    qos = {name: value for name, value in asdict(qos_of(topic)).items() if value is not None}
    return f"    qos: {', '.join(f'{name} {value}' for name, value in qos.items())}"


def _at_start(sends: bool) -> str:
    """Return what a deadman does when the router starts."""
    return "and when the router starts" if sends else "but not when the router starts"


# Gateways


def explained_gateway(checked: GatewayPlan, topics: Topics) -> Iterator[str]:
    gateway = checked.settings
    yield f"{gateway.name}: gateway, {_transport(gateway)}, {gateway.format.value}  ({gateway.span})"
    yield f"  {_period(gateway.publish_period)}; {_regularly(gateway)}"
    yield f"  messages of up to {gateway.max_outbound} bytes{_gateway_sizes(gateway)}"
    yield from _patterns(gateway)
    matched = list(_matched(TopicSelector(gateway, checked.inbound), topics))
    yield from matched
    if len(matched) > gateway.max_topics:
        yield f"  serves at most {gateway.max_topics} of these {len(matched)} topics (max_topics)"
    for inbound in checked.inbound.values():
        yield ""
        yield from _inbound(inbound)
    for call in checked.calls.values():
        yield ""
        yield f"  from clients, calls of {call.label}: {call.type_name}  ({call.span})"
        yield from (f"    {words}" for words in phrases(call.settings).values())


def ignored_gateway(gateway: IgnoredGateway) -> Iterator[str]:
    yield f"{gateway.name}: gateway  ({gateway.span})"
    yield f"  ignored: {gateway.reason}"


def _transport(gateway: Gateway) -> str:
    if gateway.zenoh is not None:
        places = [f"connects to {', '.join(gateway.zenoh.connect)}"] if gateway.zenoh.connect else []
        places += [f"listens on {', '.join(gateway.zenoh.listen)}"] if gateway.zenoh.listen else []
        places += _configured(gateway.zenoh)
        return ", ".join([f"zenoh {gateway.zenoh.mode} under {gateway.zenoh.key.value}", *places])
    assert gateway.address is not None  # noqa: S101 - only Zenoh has none
    if gateway.transport.value is not Transport.UDP:
        most = f"{gateway.max_clients} clients at most, {gateway.max_clients_per_host} from one host"
        most += f", only from {', '.join(map(str, gateway.networks))}" if gateway.networks else ""
        return f"{gateway.transport.value.value} on {gateway.address.value}, {most}"
    heard = f"on {gateway.receive.value}" if gateway.receive else "from any port"
    return f"udp to {gateway.address.value} {heard}"


def _configured(zenoh: ZenohSettings) -> list[str]:
    """Return the file or the keys that configure Zenoh; values may be secret."""
    if zenoh.config is None:
        return []
    if zenoh.config.path is not None:
        return [f"configured by {shown_path(zenoh.config.path)}"]
    return [f"configures {' and '.join(str(path[0]) for path in zenoh.config.spans if len(path) == 1)}"]


def _period(period: int) -> str:
    return "every message" if period == EACH else f"the latest value every {duration(period)}"


def _regularly(gateway: Gateway) -> str:
    again = f"schemas again every {duration(gateway.schema_period)}, "
    connected = gateway.transport.value in (Transport.TCP, Transport.WEBSOCKET)
    return f"{'' if connected else again}looks for topics every {duration(gateway.discovery_period)}"


def _gateway_sizes(gateway: Gateway) -> str:
    compressed = f", compressed with zstd {gateway.compression}" if gateway.compression else ""
    datagrams = f", in datagrams of up to {gateway.max_datagram} bytes"
    return compressed + (datagrams if gateway.format is GatewayFormat.GATEWAY_V2 else "")


def _patterns(gateway: Gateway) -> Iterator[str]:
    include = ", ".join(map(_pattern, gateway.include)) or "every topic that is not hidden"
    exclude = f", but not {', '.join(map(_pattern, gateway.exclude))}" if gateway.exclude else ""
    yield f"  sends {include}{exclude}"
    for rate in gateway.rates:
        yield f"    {_pattern(rate.pattern)}: {_period(rate.period)}"


def _pattern(pattern: TopicPattern) -> str:
    return f"regex {pattern.text}" if pattern.is_regex else pattern.text


def _matched(selector: TopicSelector, topics: Topics) -> Iterator[str]:
    rows = []
    for name in sorted(topics):
        if chosen := selector.chosen_by(name):
            rated = selector.rated_by(name)
            why = _pattern(chosen) + (f", rate of {_pattern(rated)}" if rated else "")
            rows.append((name, topics[name], _period(selector.period(name)), why))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        name, types, period, why = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield f"  ~ {name}  {types}  {period}  by {why}".rstrip()


def _inbound(plan: InboundPlan) -> Iterator[str]:
    inbound = plan.settings
    yield f"  from clients {plan.label}: {plan.type}  ({inbound.span})"
    yield _quality(inbound.topic)
    yield from (f"    {words}" for words in phrases(inbound).values())
    if inbound.topic.max_rate is not None:
        yield f"    {phrases(inbound.topic)['max_rate']}"
    if inbound.deadman is not None and plan.deadman is not None:
        deadman = inbound.deadman
        sent = str(deadman.fields) if deadman.fields.entries else "all fields at their defaults"
        yield (
            f"    deadman: {sent} when no message came for "
            f"{duration(deadman.timeout.value)}, again every {duration(deadman.repeat.value)}, "
            f"{_at_start(deadman.at_start)}"
        )


Topics = Mapping[str, str]
"""Known topics by absolute name: their type, and with `--live` the number of publishers."""


def known_topics(table: RouteTable) -> Topics:
    """Return the topics that routes and gateways of the table publish or subscribe to."""
    topics = [topic for route in table.routes for topic in route.all_topics]
    topics += [inbound.topic for gateway in table.gateways.values() for inbound in gateway.inbound]
    return {resolved(topic.topic.value, table.node): topic.type_name for topic in topics}


def seen_topics(program: CompiledTable, seconds: float) -> tuple[Topics, Sequence[Mistyped]]:
    """Return the known topics with all that a node discovers in `seconds`, and the peers of another type.

    Raises StartError.
    """
    check_environment(os.environ)
    try:
        from router.ros.graph import Ours, look
        from router.ros.node import close_node, open_node
        from router.ros.topics import RosTopics
    except ImportError as error:
        raise ConfigurationError(f"--live needs ROS 2, which is not installed here ({error})", ros_remedy()) from error
    node = open_node("router_explain")
    try:
        sleep(seconds)
        topics = RosTopics(node, known := known_topics(program.table))
        seen = {name: [publisher.type_name for publisher in topics.publishers(name)] for name in topics.names()}
        mistyped = sorted(look(node, Ours.of(program)).mistyped)
    finally:
        close_node(node)
    unseen = {name: f"{type_name}, no publisher" for name, type_name in known.items()}
    return unseen | {name: _publishers(types, known.get(name)) for name, types in seen.items() if types}, mistyped


def _publishers(types: Sequence[str], table_type: str | None) -> str:
    """Return types with their number of publishers, first the type that gateways choose.

    The table's type, which decides, is shown even without a publisher.
    """
    times = by_frequency(types)
    if table_type is None:
        return ", ".join(f"{name} of {number}" for name, number in times.items())
    ours = f"{table_type} of {times.pop(table_type)}" if table_type in times else f"{table_type}, no publisher"
    return ", ".join([ours, *(f"not {name} of {number}" for name, number in times.items())])


def live_route(route: Route, mistyped: Sequence[Mistyped]) -> Iterator[str]:
    """Yield the peers that now have another type than a topic of the route."""
    used = {(topic.topic.value, PUBLISHER) for topic in route.source_topics}
    used |= {(topic.topic.value, SUBSCRIBER) for topic in route.topics}
    if wrong := [peer for peer in mistyped if (peer.topic, peer.peer) in used]:
        yield ""
        yield from (f"  now: {peer}" for peer in wrong)


# Two tables


def diff(old: Checked, new: Checked) -> Iterator[str]:
    """Yield a unified diff of the explanations of two tables without errors, a hunk for each part that differs.

    Places and the width of columns are not compared; addresses are compared only for endpoints.
    """
    before, after = _parts(old), _parts(new)
    for name in dict.fromkeys((*after, *before)):
        hunks = difflib.unified_diff(before.get(name, ()), after.get(name, ()), lineterm="", n=1)
        for number, line in enumerate(hunks):
            if number >= 2:  # after the names of the files
                yield f"{line} {name}" if line.startswith("@@") else line


_PLACE = re.compile(r"  \(\S+:\d+:\d+\)$")
_ADDRESS = re.compile(r" \(\d+(?:\.\d+){3}[^)]*\)")
_GAP = re.compile(r"(?<=\S)(?: {2,}|\s*\n\s*)")


def _parts(checked: Checked) -> dict[str, list[str]]:
    """Return the lines to compare, of each route, gateway, listener and endpoint, and of the rest of the table."""
    table = checked.table
    assert table is not None  # noqa: S101 - a table without errors is one
    settings = {
        "node": {"name": table.node.name, "namespace": table.node.namespace},
        "node.diagnostics": table.node.diagnostics is not None,
        "reload.on_change": table.reload_on_change,
        "http": table.http,
        "foxglove": table.foxglove,
        "record": table.record,
    }
    parts = {"table": _settings_lines(settings)}
    parts |= {
        f"listener {name}": _settings_lines(listener.link or listener) for name, listener in table.listeners.items()
    }
    parts |= {f"endpoint {name}": _settings_lines(endpoint) for name, endpoint in table.endpoints.items()}
    for route in checked.routes:
        parts[f"route {route.route.name}"] = _comparable(explained_route(route, checked))
    for state in checked.states.values():
        parts[state.label] = _comparable(explained_state(state, checked))
    for service in checked.services:
        parts[service_label(service.declared.name)] = _comparable(explained_service(service))
    for called in checked.called:
        parts[service_label(called.declared.name)] = _comparable(explained_called(called, table))
    for gateway in checked.gateways:
        parts[f"gateway {gateway.settings.name}"] = [
            *_comparable(explained_gateway(gateway, {})),
            *_zenoh_config(gateway.settings),
        ]
    for ignored in table.ignored_gateways.values():
        parts[f"gateway {ignored.name}"] = _comparable(ignored_gateway(ignored))
    return parts


def _settings_lines(settings: object) -> list[str]:
    return [f"  {key}: {' '.join(text.split())}" for key, text in flat(settings).items() if key != "name"]


def _comparable(lines: Iterable[str]) -> list[str]:
    return [_GAP.sub("  ", _ADDRESS.sub("", _PLACE.sub("", line))) for line in lines if line]


def _zenoh_config(gateway: Gateway) -> Iterator[str]:
    """Yield a checksum of the configuration, as its contents may be secret."""
    if gateway.zenoh is not None and gateway.zenoh.config is not None:
        config = gateway.zenoh.config
        yield f"  zenoh.config: {config.path or 'here'} ({hash(config.text) & 0xFFFFFF:06x})"

"""Checks deadmen: their timing, the payloads that they send, and commands to boards without a deadman.

`gateways` uses this module for the deadmen of topics that clients publish on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import chain

from router.compiler.compiled_table import DeadmanPlan
from router.compiler.constants import envelope_of
from router.compiler.expressions.functions import NS_PER_SECOND
from router.compiler.feeds import feeding, require_hand_over, successors
from router.compiler.lookup import Lookup
from router.compiler.mapping import build
from router.compiler.plan import Record
from router.declared import MOST_DESTINATIONS
from router.errors import Code, Diagnostic, FindingError, Located, SourceSpan
from router.table.model.expressions import FieldMap
from router.table.model.gateways import InboundDeadman
from router.table.model.routes import DEFAULT_REPEAT, Deadman, Payload, Route
from router.table.model.targets import OnLimit
from router.table.units import duration
from router.types.board_limits import scalars
from router.types.framing import trimmed
from router.types.model import MessageType

SHORTEST_REPEAT = 10_000_000
"""ns. A shorter interval would flood a board, which may still be busy with the last datagram."""

SHORTEST_TIMEOUT, LONGEST_TIMEOUT = 20_000_000, 10 * NS_PER_SECOND
"""ns. Commands rarely arrive faster, and a rover moves far within 10 s: other values are probably in the wrong unit."""

_NOTHING = MessageType("a deadman")
"""The source message of a deadman's payload: a message without fields."""


def check_deadman(lookup: Lookup, route: Route) -> DeadmanPlan | None:
    """Check the deadman of a route. Return None if it has none, or if it is invalid."""
    deadman = route.deadman
    if deadman is None:
        _require_deadman(lookup, route)
        return None
    _require_commands(lookup, route, deadman)
    disarmed_by = successors(lookup, route, deadman)
    if len(deadman.to) > MOST_DESTINATIONS:
        message = f"a deadman sends to at most {MOST_DESTINATIONS} endpoints, not {len(deadman.to)}"
        lookup.report(deadman.to[0].span, Code.BAD_VALUE, message, "divide them among several routes")
        return None
    sent = [_datagrams(lookup, deadman, payload) for payload in deadman.payloads]
    datagrams = [by_name for by_name in sent if by_name is not None]
    if len(datagrams) < len(sent):
        return None
    commanded = {destination.endpoint.value for destination in route.destinations}
    others = frozenset(to.value for to in deadman.to) - commanded
    following = others if len(others) < len(deadman.to) else frozenset()
    trims = {name for name, endpoint in lookup.table.endpoints.items() if endpoint.trim_trailing_zeros}
    beside = {to.value: lookup.beside[to.value] for to in deadman.to if to.value in lookup.beside}
    by_endpoint = []
    for to in deadman.to:
        before = beside[to.value].data if to.value in beside else b""
        whole = (before + by_name[to.value] for by_name in datagrams if to.value in by_name)
        by_endpoint.append((to.value, tuple(trimmed(data) if to.value in trims else data for data in whole)))
    sources = *(source.value for source in route.sources), *(topic.topic.value for topic in route.source_topics)
    watched = frozenset((source, route.case.value) for source in sources)
    plan = deadman_plan(route.name, deadman, by_endpoint)
    return replace(plan, following=following, disarmed_by=disarmed_by, watched=watched, beside=beside)


def _require_deadman(lookup: Lookup, route: Route) -> None:
    """Warn about the first board that gets commands or replies from a route without a deadman."""
    for destination in route.destinations:
        name = destination.endpoint.value
        if route.no_deadman is None and name in lookup.boards:
            message = f"nothing stops '{name}' when '{route.case.value}' stops arriving"
            hint = "write `deadman: {timeout: 500ms, send: {CASE: {FIELD: VALUE}}}`, or `deadman: {none: why}`"
            lookup.report(destination.endpoint.span, Code.NO_DEADMAN, message, hint)
            return
    board = next((source.value for source in route.sources if source.value in lookup.boards), None)
    if route.reply is not None and board is not None and route.no_deadman is None:
        message = f"'{board}' is a board, and replies feed no deadman: nothing stops what they move"
        hint = "if they move nothing, write `deadman: {none: replies move nothing}`"
        lookup.report(route.reply.case.span, Code.NO_DEADMAN, message, hint)


def _require_commands(lookup: Lookup, route: Route, deadman: Deadman) -> None:
    if not route.destinations:
        if route.topics or route.reply is not None:
            message = f"'{route.case.value}' has no destinations, so there are no commands to watch"
            lookup.report(deadman.span, Code.UNKNOWN_KEY, message, "remove the deadman, or add destinations")
        return
    rates = [destination.max_rate for destination in feeding(route, deadman)]
    limited = [rate for rate in rates if rate is not None]
    max_rate = max(limited) if len(limited) == len(rates) else None
    are_late = _report_late_commands(lookup, route, deadman)
    lookup.findings += timing_findings(deadman, None if are_late else route.ttl, max_rate, "datagrams")
    if deadman.because is None:
        _require_all_boards(lookup, route, deadman)
        require_hand_over(lookup, route, deadman)


def timing_findings(
    deadman: Deadman | InboundDeadman, ttl: Located[int] | None, max_rate: float | None, sends: str
) -> Iterator[Diagnostic]:
    """Yield findings for a deadman that trips between commands, sends too often, or has implausible times.

    `max_rate` (Hz) limits all its commands.
    """
    if max_rate is not None and deadman.timeout.value * max_rate <= NS_PER_SECOND:
        message = f"the deadman would trip between commands: `max_rate` limits them to {max_rate:g} Hz"
        yield Diagnostic(deadman.timeout.span, Code.BAD_VALUE, message, "raise the timeout, or max_rate")
    if deadman.repeat.value < SHORTEST_REPEAT:
        message = f"more than 100 {sends} per second would flood the receivers"
        yield Diagnostic(deadman.repeat.span, Code.BAD_VALUE, message, "set it to 10ms or more")
    if deadman.because is None:
        for span, message, hint in _doubtful_times(deadman, ttl):
            yield Diagnostic(span, Code.DOUBTFUL_DEADMAN, message, f"{hint}, or add `because: why`")


def _doubtful_times(
    deadman: Deadman | InboundDeadman, ttl: Located[int] | None
) -> Iterator[tuple[SourceSpan, str, str]]:
    """Yield position, message and hint for each implausible time."""
    timeout, repeat = deadman.timeout, deadman.repeat
    time = duration(timeout.value)
    if timeout.value > LONGEST_TIMEOUT:
        yield (
            timeout.span,
            f"everything keeps moving for {time} after the last command",
            "set for example `timeout: 500ms`",
        )
    elif timeout.value < SHORTEST_TIMEOUT:
        message = f"the deadman trips between commands unless they arrive more often than every {time}"
        yield timeout.span, message, "set `timeout` to at least 20ms"
    if repeat.value > max(2 * timeout.value, DEFAULT_REPEAT.value):
        message = f"if the deadman's message is lost, the next one follows {duration(repeat.value)} later"
        yield repeat.span, message, f"repeat it within the timeout of {time}"
    if ttl is not None and ttl.value > timeout.value:
        message = f"a command that is {duration(ttl.value)} late would release the deadman, which trips after {time}"
        yield ttl.span, message, f"set `ttl` to at most {time.replace(' ', '')}"


def _require_all_boards(lookup: Lookup, route: Route, deadman: Deadman) -> None:
    """Report the first board that receives commands from the route but is not stopped by the deadman."""
    stopped = {to.value for to in deadman.to}
    if not stopped <= lookup.table.endpoints.keys():
        return  # unknown endpoints have a finding already
    for destination in route.destinations:
        name = destination.endpoint.value
        if name not in stopped and name in lookup.boards:
            message = f"'{name}' receives '{route.case.value}' but is not in `to`, so nothing stops it"
            hint = "add it to `to`, give it its own route, or add `because: why`"
            lookup.report(deadman.to[0].span, Code.DOUBTFUL_DEADMAN, message, hint)
            return


def _report_late_commands(lookup: Lookup, route: Route, deadman: Deadman) -> bool:
    """Report commands that may be sent after the timeout and undo the deadman. Return whether there are any."""
    if route.ttl is not None and route.ttl.value <= deadman.timeout.value:
        return False
    for destination in route.destinations:
        endpoint = lookup.table.endpoints.get(destination.endpoint.value)
        waits_for = "`on_limit: latest`" if destination.on_limit is OnLimit.LATEST else "the endpoint's bandwidth"
        if destination.on_limit is OnLimit.LATEST or (endpoint is not None and endpoint.bandwidth is not None):
            message = f"a command that waits for {waits_for} could be sent after the timeout and undo the deadman"
            span = route.ttl.span if route.ttl else destination.endpoint.span
            lookup.report(span, Code.BAD_VALUE, message, "give the route a 'ttl' no longer than the deadman's timeout")
            return True
    return False


def _datagrams(lookup: Lookup, deadman: Deadman, payload: Payload) -> Mapping[str, bytes] | None:
    """Return a payload of the deadman in the envelope of each endpoint, by its name; None with a finding."""
    case = lookup.case(payload.case)
    if case is None:
        return None
    known = len(lookup.findings)
    recipients = [found for name in deadman.to if (found := lookup.recipient(case, name, sources=frozenset()))]
    can_reach = len(lookup.findings) == known
    plan = constant_plan(lookup, payload.fields, case.type, payload.case.span)
    if plan is None:
        return None
    held_as = {each.case.name: each.case for each in recipients}
    try:
        made = {name: envelope_of(plan, held) for name, held in held_as.items()}
    except FindingError as error:
        lookup.findings.append(error.diagnostic)
        return None
    datagrams = {each.endpoint.name: made[each.case.name] for each in recipients}
    return None if can_reach and _is_refused(lookup, payload, datagrams) else datagrams


def _is_refused(lookup: Lookup, payload: Payload, datagrams: Mapping[str, bytes]) -> bool:
    """Report the first board that cannot decode the envelope of a payload. Return whether there is one.

    The size was checked with the payload case.
    """
    for name in (name for name in datagrams if name in lookup.boards):
        board, around = lookup.boards[name], lookup.envelopes.to(name)
        envelope = around.message_class.FromString(datagrams[name])
        payloads = around.payloads_of(envelope)
        held = [(message, board.payload(case)) for case, message in payloads if case.number in board.payloads]
        for field, value in chain(*(scalars(*each) for each in [(envelope, board.fields), *held])):
            if misfit := board.misfit(field, value):
                allow = f"set `allow_non_finite: true` for '{name}' if its firmware handles {value}"
                hint = f"send a finite number, or {allow}" if isinstance(value, float) else ""
                lookup.report(payload.case.span, Code.BOARD_PAYLOAD, f"a board rejects this: {misfit}", hint)
                return True
    return False


def deadman_plan(
    name: str, settings: Deadman | InboundDeadman, datagrams: Iterable[tuple[str, tuple[bytes, ...]]]
) -> DeadmanPlan:
    timeout, repeat = settings.timeout.value, settings.repeat.value
    return DeadmanPlan(name, timeout, repeat, tuple(datagrams), settings.at_start)


def constant_plan(
    lookup: Lookup, fields: FieldMap, target: MessageType, span: SourceSpan, ros_type: MessageType | None = None
) -> Record | None:
    """Return the plan of a message of constants, None if there are findings. The plan may be empty.

    Expressions can name the constants of `ros_type`.
    """
    scope = replace(lookup.scope(_NOTHING, ros_type), given=())
    mapping = build(fields, target, scope, span)
    findings = [finding for finding in mapping.findings if finding.code is not Code.NOTHING_MAPPED]
    lookup.findings += findings
    return None if findings else mapping.plan

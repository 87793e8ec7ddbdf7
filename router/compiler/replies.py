"""Checks replies: what the router itself answers to the sender of a datagram."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from router.compiler.checked import CheckedRoute, Target
from router.compiler.lookup import Lookup
from router.compiler.mapping import build
from router.errors import Code, Diagnostic, Located, listed
from router.table.model.routes import ANY, Deadman, Route
from router.table.model.targets import USUAL_REPLY_RATE, Destination, Reply
from router.types.protobuf import PayloadCase


def check_reply(lookup: Lookup, route: Route, case: PayloadCase) -> list[Target]:
    """Check the reply of a route. Return a target for each endpoint that gets it; none after a finding about all."""
    reply = route.reply
    if reply is None:
        return []
    sent = lookup.case(reply.case)
    if sent is None:
        return []
    if any(source.value == ANY for source in route.sources):
        message = f"'{ANY}' accepts strangers, whose addresses may be forged: the router replies only to endpoints"
        lookup.report(reply.span, Code.BAD_VALUE, message, "name the endpoints in 'source'")
        return []
    scope = lookup.received(case, route=route)
    mapping = build(reply.fields, sent.type, scope, reply.span, None, sent.type)
    may_be_empty = reply.fields is not None and not reply.fields.auto
    lookup.findings += [
        finding for finding in mapping.findings if not (may_be_empty and finding.code is Code.NOTHING_MAPPED)
    ]
    when = lookup.when(reply.when, scope)
    targets = []
    for source in route.sources:
        if source.value not in lookup.table.endpoints:
            continue  # it has a finding already
        recipient = lookup.recipient(sent, Located(source.value, reply.case.span), sources=frozenset())
        if recipient is None:
            continue
        _require_unguarded(lookup, reply, source.value)
        max_rate = reply.max_rate or USUAL_REPLY_RATE
        declared = Destination(source, reply.span, reply.fields, when=reply.when, max_rate=max_rate)
        beside, rows = lookup.beside.get(source.value), tuple(mapping.rows)
        target = Target(declared, recipient.endpoint, when=when, plan=mapping.plan, rows=rows, beside=beside)
        targets.append(replace(target, reply=recipient.case))
    return targets


def _require_unguarded(lookup: Lookup, reply: Reply, endpoint: str) -> None:
    """Report a reply that is a command for an endpoint that a deadman stops: it would not feed the deadman."""
    for route in lookup.table.routes:
        deadman, name = route.deadman, reply.case.value
        if deadman is None or name not in _commands(lookup, route, deadman):
            continue
        if endpoint in {to.value for to in deadman.to} | {to.endpoint.value for to in route.destinations}:
            message = f"replies feed no deadman, and that of '{route.name}' guards '{name}' to '{endpoint}'"
            hint = f"reply with another payload case: nothing would stop '{endpoint}' after this one"
            lookup.report(reply.case.span, Code.BAD_VALUE, message, hint)
            return


def _commands(lookup: Lookup, route: Route, deadman: Deadman) -> set[str]:
    """Return the payload cases that feed a deadman, that it sends, or that disarm it."""
    others = [name.value for name in deadman.disarmed_by or ()]
    named = {lookup.routes[name].case.value if name in lookup.routes else name for name in others}
    return {route.case.value, *(payload.case.value for payload in deadman.payloads), *named}


# replies to replies


def reply_findings(routes: Iterable[CheckedRoute]) -> Iterator[Diagnostic]:
    """Yield a finding for each circle of replies without conditions: the last one's case is answered by the first.

    A case that is answered with itself is a handshake, in which one side begins and does not answer the reply.
    """
    by_source: dict[str, dict[str, Reply]] = {}
    for checked in routes:
        reply = checked.route.reply
        if reply is not None and reply.when is None:
            for source in checked.route.sources:
                by_source.setdefault(source.value, {})[checked.case.name] = reply
    for endpoint, replies in by_source.items():
        seen: set[str] = set()
        for case in replies:
            circle = _circle(replies, case)
            if len(circle) > 1 and seen.isdisjoint(circle):
                yield _endless(endpoint, circle, replies[case])
            seen.update(circle)


def _circle(replies: Mapping[str, Reply], start: str) -> list[str]:
    """Return the payload cases of the circle of replies that `start` is part of; none if there is no circle."""
    cases = [start]
    while (reply := replies.get(cases[-1])) is not None and reply.case.value not in cases:
        cases.append(reply.case.value)
    return cases if reply is not None and reply.case.value == start else []


def _endless(endpoint: str, circle: list[str], reply: Reply) -> Diagnostic:
    following = [*circle[1:], circle[0]]
    steps = listed([f"'{case}' with '{answer}'" for case, answer in zip(circle, following, strict=True)])
    message = f"the router answers {steps}: if '{endpoint}' answers one of them too, this never ends"
    return Diagnostic(reply.case.span, Code.FORWARDING_LOOP, message, "remove one of the replies, or add `when` to it")

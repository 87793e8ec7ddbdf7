"""The carrier as a plane for the judge of the language (tests/compiler/judging.py)."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

from router.compiler.checked import CheckedCollect, CheckedRoute, CheckedSubscription, Target
from router.compiler.expressions import Scope, check
from router.compiler.lowering import LoweredFeed, LoweredRoute, lower_table
from router.errors import Located
from router.table.model.routes import Route
from router.table.model.targets import Destination, Topic
from tests.carrier.delivering import Delivering, Outcome, Payload
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN, written
from tests.compiler.judging import Answer, Misfit, Plane, Question
from tests.compiler.language import language_wire

_ROUTE = "route"
_TIMEOUT = 10
"""The timeout of frames, in ns."""


def carrier_plane(functions: ctypes.CDLL) -> Plane:
    """A plane that answers with the functions of delivering.c."""

    def plane(asked: Question) -> Callable[[bytes], list[Answer]]:
        carrier = Delivering(functions, _lowered(asked), RECEIVED_AT, SOURCE, timeout=_TIMEOUT)

        now = count(1, _TIMEOUT)

        def answers(message: Any) -> list[Answer]:
            if asked.language.is_frame:
                return [outcome.got for outcome in _framed(carrier, message, next(now))]
            is_ros = asked.language.is_ros
            outcomes = carrier.from_ros(message) if is_ros else carrier.datagram(message)
            return [outcome.got for outcome in outcomes]

        return answers

    return plane


def _collect(asked: Question) -> CheckedCollect:
    scope = Scope(asked.source, asked.enums, ())
    by, size, place = (check(written(text), scope) for text in ("0", "message.from", "message.in"))
    return CheckedCollect(SPAN, by, size, place)


def _framed(carrier: Delivering, payloads: Sequence[bytes], now: int) -> list[Outcome]:
    """The outcomes of a frame with these payloads, in any order. Earlier frames have been forgotten."""
    shuffled = random.Random(payloads[0]).sample(payloads, len(payloads))
    *earlier, last = (carrier.part(b"\0" + each, now, payload=Payload(1, len(each), True)) for each in shuffled)
    assert not any(earlier)
    assert last is not None
    return last


def _lowered(asked: Question) -> LoweredRoute | LoweredFeed:
    """The programs of a question. A message from ROS comes from the topic SOURCE."""
    for_each, condition, plan = asked.checked()
    topic, span = Topic(Located(SOURCE, SPAN), SPAN), SPAN
    route, envelope = Route(name=_ROUTE, span=span, case=Located(_ROUTE, span)), language_wire()[1]
    if asked.language.is_ros:
        target = Target(Destination(Located("endpoint", span), span), plan=plan)
        feed = CheckedSubscription(topic, asked.source, condition, for_each, None, (target,))
        lowered, findings = lower_table([CheckedRoute(route, asked.case, subscriptions=(feed,))])
    else:
        declared = topic if plan is not None else Destination(Located("endpoint", span), span)
        target = Target(declared, type=asked.target, when=condition, plan=plan, for_each=for_each)
        case, collect = envelope.cases["source"], _collect(asked) if asked.language.is_frame else None
        lowered, findings = lower_table([CheckedRoute(route, case, (target,), collect=collect)])
    if findings:
        raise Misfit(findings)
    if asked.language.is_ros:
        (made,) = lowered.from_ros[SOURCE]
        return made
    return lowered.to_topics[_ROUTE] if plan is not None else lowered.to_destinations[_ROUTE]

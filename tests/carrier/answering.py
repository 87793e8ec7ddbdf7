"""The carrier as a plane of the language's judge (tests/compiler/judging.py)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

from router.compiler.checked import CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.lowering import LoweredFeed, LoweredRoute, lower_table
from router.errors import Located
from router.table.model import Destination, Route, Topic
from tests.carrier.delivering import Delivering
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN
from tests.compiler.judging import Answer, Misfit, Plane, Question
from tests.compiler.language import language_wire

_ROUTE = "route"


def carrier_plane(functions: ctypes.CDLL) -> Plane:
    """Answers by what delivers to targets (delivering.c)."""

    def plane(asked: Question) -> Callable[[bytes], list[Answer]]:
        carrier = Delivering(functions, _lowered(asked), RECEIVED_AT, SOURCE)

        def answers(message: bytes) -> list[Answer]:
            is_ros = asked.language.is_ros
            outcomes = carrier.from_ros(message) if is_ros else carrier.datagram(message, is_single=True)
            return [outcome.got for outcome in outcomes]

        return answers

    return plane


def _lowered(asked: Question) -> LoweredRoute | LoweredFeed:
    """The programs of a question. One from ROS comes from a topic that is called SOURCE."""
    for_each, condition, plan = asked.checked()
    topic, span = Topic(Located(SOURCE, SPAN), SPAN), SPAN
    route, envelope = Route(name=_ROUTE, span=span, case=Located(_ROUTE, span)), language_wire()[1]
    if asked.language.is_ros:
        target = CheckedTarget(Destination(Located("endpoint", span), span), plan=plan)
        feed = CheckedSubscription(topic, asked.source, condition, for_each, None, (target,))
        lowered, findings = lower_table([CheckedRoute(route, asked.case, subscriptions=(feed,))], envelope)
    else:
        declared = topic if plan is not None else Destination(Located("endpoint", span), span)
        target = CheckedTarget(declared, type=asked.target, when=condition, plan=plan)
        lowered, findings = lower_table([CheckedRoute(route, envelope.cases["source"], (target,))], envelope)
    if findings:
        raise Misfit(findings)
    if asked.language.is_ros:
        (made,) = lowered.from_ros[SOURCE]
        return made
    return lowered.topics[_ROUTE] if plan is not None else lowered.conditions[_ROUTE]

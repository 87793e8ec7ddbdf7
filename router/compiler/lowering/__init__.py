"""Lowers the routes of a table without errors to the routines that the carrier executes.

Each target is lowered once. A routine that is too large is a finding.
"""

from __future__ import annotations

from collections.abc import Sequence

from router.compiler.checked import CheckedRoute
from router.compiler.expressions.tree import Node
from router.compiler.lowering.lowered import (
    Lowered,
    LoweredCollect,
    LoweredCondition,
    LoweredElements,
    LoweredFeed,
    LoweredRoute,
)
from router.compiler.lowering.names import TooLargeError
from router.compiler.lowering.sources import Datagram, RosMessage
from router.errors import Diagnostic
from router.types.protobuf import Envelope, PayloadCase

__all__ = [
    "Lowered",
    "LoweredCollect",
    "LoweredCondition",
    "LoweredElements",
    "LoweredFeed",
    "LoweredRoute",
    "lower_condition",
    "lower_table",
]


def lower_table(routes: Sequence[CheckedRoute], envelope: Envelope | None = None) -> tuple[Lowered, list[Diagnostic]]:
    """Lower all targets of a table without errors. Return findings for those that are too large."""
    to_destinations: dict[str, LoweredRoute] = {}
    to_topics: dict[str, LoweredRoute] = {}
    from_ros: dict[str, tuple[LoweredFeed, ...]] = {}
    obeyed: dict[str, LoweredCondition] = {}
    findings: list[Diagnostic] = []
    for checked in routes:
        filtered = [target for target in checked.targets if not target.topic and target.when is not None]
        published = [target for target in checked.targets if target.topic]
        for targets, lowered in ((filtered, to_destinations), (published, to_topics)):
            try:
                if targets:
                    lowered[checked.route.name] = Datagram(checked.case, envelope).lowered(checked, targets)
            except TooLargeError as error:
                findings.append(error.diagnostic)
        for feed in checked.subscriptions:
            topic = feed.topic.topic.value
            try:
                from_ros[topic] = (*from_ros.get(topic, ()), RosMessage(feed.type, topic).lowered(checked, feed))
            except TooLargeError as error:
                findings.append(error.diagnostic)
        try:
            if checked.obeyed is not None:
                when, case = checked.obeyed.when, checked.obeyed.case
                obeyed[checked.route.name] = lower_condition(when, case, envelope, is_bounded=True)
        except TooLargeError as error:
            findings.append(error.diagnostic)
    return Lowered(to_destinations, to_topics, from_ros, obeyed), findings


def lower_condition(
    condition: Node, case: PayloadCase, envelope: Envelope | None = None, *, is_bounded: bool = False
) -> LoweredCondition:
    """Lower a single condition on a payload. Raises TooLargeError. `is_bounded`: the receive thread evaluates it."""
    source = Datagram(case, envelope)
    routine, _ = source.condition(source.lowering(), [condition], is_bounded=is_bounded)
    return LoweredCondition(routine, source.layout(condition.span))

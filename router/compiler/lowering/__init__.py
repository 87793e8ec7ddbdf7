"""Lowers the routes of a table without errors to the routines that the carrier executes.

Each target is lowered once. A routine that is too large is a finding.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from router.compiler.checked import CheckedRoute, CheckedState
from router.compiler.expressions.tree import Node
from router.compiler.lowering.lowered import (
    Lowered,
    LoweredCollect,
    LoweredCondition,
    LoweredElements,
    LoweredFeed,
    LoweredOrder,
    LoweredRoute,
    LoweredState,
)
from router.compiler.lowering.names import TooLargeError
from router.compiler.lowering.sources import Datagram, RosMessage
from router.errors import Diagnostic
from router.types.protobuf import Envelope, PayloadCase
from router.types.table_envelopes import Envelopes

__all__ = [
    "Lowered",
    "LoweredCollect",
    "LoweredCondition",
    "LoweredElements",
    "LoweredFeed",
    "LoweredOrder",
    "LoweredRoute",
    "LoweredState",
    "lower_condition",
    "lower_table",
]


@contextmanager
def _limits_in(findings: list[Diagnostic]) -> Iterator[None]:
    """Add the finding about what is too large."""
    try:
        yield
    except TooLargeError as error:
        findings.append(error.diagnostic)


_NO_STATES: Mapping[str, CheckedState] = {}


def lower_table(
    routes: Sequence[CheckedRoute], envelopes: Envelopes | None = None, states: Mapping[str, CheckedState] = _NO_STATES
) -> tuple[Lowered, list[Diagnostic]]:
    """Lower all targets and states of a table without errors. Return findings for those that are too large."""
    names = tuple(states)
    to_destinations: dict[str, LoweredRoute] = {}
    to_topics: dict[str, LoweredRoute] = {}
    from_ros: dict[str, tuple[LoweredFeed, ...]] = {}
    order: dict[str, LoweredOrder] = {}
    obeyed: dict[str, LoweredCondition] = {}
    replies: dict[str, LoweredRoute] = {}
    findings: list[Diagnostic] = []
    for checked in routes:
        answering = [target for target in checked.targets if target.reply]
        forwarding = [target for target in checked.targets if not target.topic and not target.reply]
        filtered = [target for target in forwarding if target.when or target.rewrapped]
        published = [target for target in checked.targets if target.topic]
        for targets, lowered in ((filtered, to_destinations), (published, to_topics), (answering, replies)):
            with _limits_in(findings):
                if targets:
                    source = Datagram(checked.case, _holder(envelopes, checked.case), names)
                    lowered[checked.route.name] = source.lowered(checked, targets)
        for feed in checked.subscriptions:
            topic = feed.topic.topic.value
            with _limits_in(findings):
                message = RosMessage(feed.type, topic, names)
                from_ros[topic] = (*from_ros.get(topic, ()), message.lowered(checked, feed))
        with _limits_in(findings):
            if checked.order is not None:
                source = Datagram(checked.case, _holder(envelopes, checked.case))
                order[checked.route.name] = source.ordered(checked.order)
        with _limits_in(findings):
            if checked.obeyed is not None:
                when, case = checked.obeyed.when, checked.obeyed.case
                obeyed[checked.route.name] = lower_condition(when, case, _holder(envelopes, case), is_bounded=True)
    values = _lower_states(states, envelopes, findings)
    for topic, of_state in _feeds(states, values):
        from_ros[topic] = (*from_ros.get(topic, ()), of_state)
    return Lowered(to_destinations, to_topics, from_ros, order, obeyed, values, replies), findings


def _lower_states(
    states: Mapping[str, CheckedState], envelopes: Envelopes | None, findings: list[Diagnostic]
) -> Mapping[str, LoweredState]:
    lowered = {}
    for name, state in states.items():
        with _limits_in(findings):
            if state.feed is not None:
                lowered[name] = RosMessage(state.feed.type, state.feed.topic.topic.value).state(state, state.feed)
            elif state.case is not None:
                lowered[name] = Datagram(state.case, _holder(envelopes, state.case)).state(state)
    return lowered


def _holder(envelopes: Envelopes | None, case: PayloadCase) -> Envelope | None:
    return envelopes.of(case.name) if envelopes is not None else None


def _feeds(
    states: Mapping[str, CheckedState], lowered: Mapping[str, LoweredState]
) -> Iterator[tuple[str, LoweredFeed]]:
    """Yield the topics that set states, which are urgent."""
    for name, value in lowered.items():
        state = states[name]
        if state.feed is not None:
            yield state.feed.topic.topic.value, LoweredFeed(state.label, True, {}, value.layout, value.stamp, None)


def lower_condition(
    condition: Node, case: PayloadCase, envelope: Envelope | None = None, *, is_bounded: bool = False
) -> LoweredCondition:
    """Lower a single condition on a payload. Raises TooLargeError. `is_bounded`: the receive thread evaluates it."""
    source = Datagram(case, envelope)
    routine, _ = source.condition(source.lowering(), [condition], is_bounded=is_bounded)
    return LoweredCondition(routine, source.layout(condition.span))

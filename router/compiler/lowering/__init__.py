"""Topics that need no Python: from checked routes to programs with which the carrier publishes.

A topic gets its messages in order, from whatever route they come. So one executor serves it: Python, if one route that
publishes on it needs Python.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from google.protobuf.descriptor import Descriptor

from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.executors import CARRIER, Executor, Executors
from router.compiler.lowering.expressions import Lowering, Names, readable
from router.compiler.lowering.messages import MessageWriter, Unlowered
from router.compiler.lowering.operations import (
    MAX_DATAGRAM,
    MOST_NODES_DEEP,
    MOST_SLOTS,
    MOST_STACKED,
    Code,
    Layout,
    Node,
    Slot,
    deepest,
    layout,
)
from router.compiler.lowering.values import INT64, Integer, NeedsPython, Text
from router.errors import SourceSpan
from router.table.model import OnLimit
from router.types.protobuf import Envelope

_MOST_OPERATIONS = 0xFFFF - 2  # an `enum place` has 16 bits


@dataclass(frozen=True, slots=True)
class LoweredTarget:
    """What makes the message of a topic. `condition` is its `when`, or nothing.

    `places` say where in the table a message may be refused, by `enum place` in `native/events.h`: "", the condition,
    and what each operation fills.
    """

    label: str
    condition: Code
    operations: Code
    places: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LoweredRoute:
    """The topics of a route that the carrier publishes on, by name, and the fields that they read."""

    targets: Mapping[str, LoweredTarget]
    layout: Layout


@dataclass(frozen=True, slots=True)
class LoweredTopics:
    """`routes` by name; `executors` of all topics that are published on."""

    routes: Mapping[str, LoweredRoute]
    executors: Executors


def lower_topics(routes: Sequence[CheckedRoute], envelope: Envelope) -> LoweredTopics:
    """Lower what can be lowered of a table without errors."""
    executors = _executors(routes, envelope)
    lowered = {}
    for checked in routes:
        carried = [to for to in _published(checked) if executors[checked.route.name, to.label, None].is_carrier]
        if carried:
            lowered[checked.route.name] = lower(checked, carried, envelope)
    return LoweredTopics(lowered, executors)


def _published(checked: CheckedRoute) -> list[CheckedTarget]:
    return [target for target in checked.targets if target.topic]


def _executors(routes: Sequence[CheckedRoute], envelope: Envelope) -> Executors:
    own: dict[tuple[str, str], Executor] = {}
    needs_python: dict[str, tuple[str, SourceSpan]] = {}  # by topic: the first route that does, and its target
    for checked in routes:
        for target in _published(checked):
            executor = own[checked.route.name, target.label] = _own_executor(checked, target, envelope)
            if not executor.is_carrier:
                needs_python.setdefault(target.label, (checked.route.name, target.span))
    return {
        (route, topic, None): _shared(topic, *needs_python[topic])
        if executor.is_carrier and topic in needs_python
        else executor
        for (route, topic), executor in own.items()
    }


def _own_executor(checked: CheckedRoute, target: CheckedTarget, envelope: Envelope) -> Executor:
    """The executor of a target, without regard to others of its topic."""
    return Executor("typed trees are not lowered yet", target.span)
    if checked.collect is not None:
        return Executor("`collect` needs it", checked.collect.span)
    if target.declared.on_limit is OnLimit.LATEST:
        return Executor("`on_limit: latest` needs it", target.span)
    try:
        lower(checked, [target], envelope)
    except Unlowered as reason:
        return Executor(str(reason), reason.span)
    return CARRIER


def _shared(topic: str, route: str, span: SourceSpan) -> Executor:
    return Executor(f"it shares '{topic}' with {route}, which needs Python", span)


def lower(checked: CheckedRoute, targets: Sequence[CheckedTarget], envelope: Envelope) -> LoweredRoute:
    """Lower topics of a route. Raises Unlowered."""
    descriptor: Descriptor = checked.case.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's
    around: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]
    payload = Node(descriptor)
    received_at, source = Slot(0), Slot(b"")
    slots, elements = [received_at, source], list[Node]()
    made = {}
    for target in targets:
        names = Names({}, {"received_at": (received_at, Integer(*INT64)), "source": (source, Text(MAX_DATAGRAM))})
        _name_messages(names, target, payload)
        made[target.label] = _target(target, Lowering(names))
        slots += names.temporaries
        elements += names.elements
    laid_out = layout(slots, payload, around, checked.case.name, elements)
    _want_room(laid_out, [payload, *elements], made, targets[0].span)
    return LoweredRoute(made, laid_out)


def _name_messages(names: Names, target: CheckedTarget, payload: Node) -> None:
    """The variables of the generated handlers, each of which is a message in the payload."""
    reads = target.reads
    assert isinstance(reads, ParsedReads)  # noqa: S101 - of a route from UDP
    for path, variable in reads.variables.items():
        node = payload
        for name in path:
            node = node.message(_readable_message(node, name, target))
        names.messages[variable] = node


def _readable_message(node: Node, name: str, target: CheckedTarget) -> str:
    try:
        return readable(node, name).name
    except NeedsPython as reason:
        raise Unlowered(target.label, str(reason), target.span) from None


def _target(target: CheckedTarget, lowering: Lowering) -> LoweredTarget:
    assert target.plan is not None  # noqa: S101 - a topic has one
    condition: Code = ()
    place = ""
    if target.when is not None:
        place = f"{target.when.span}: when"
        try:
            condition = lowering.value(target.when.node).code
        except NeedsPython as reason:
            raise Unlowered(f"when: {target.declared.when}", str(reason), target.when.span) from None
    rows = {row.target: row.expression for row in target.rows}
    placed = MessageWriter(lowering, rows).message(target.plan)
    operations, places = zip(*placed, strict=True)
    return LoweredTarget(target.label, condition, operations, ("", place, *places))


def _want_room(laid_out: Layout, nodes: Sequence[Node], targets: Mapping[str, LoweredTarget], span: SourceSpan) -> None:
    """Raise Unlowered for what is larger than the carrier provides for."""
    codes = [code for target in targets.values() for code in (target.condition, target.operations)]
    is_small = (
        len(laid_out.defaults) <= MOST_SLOTS
        and max(node.depth() for node in nodes) < MOST_NODES_DEEP - 1
        and all(len(code) <= _MOST_OPERATIONS and deepest(code) <= MOST_STACKED for code in codes)
    )
    if not is_small:
        raise Unlowered(", ".join(targets), "its expressions are too large", span)

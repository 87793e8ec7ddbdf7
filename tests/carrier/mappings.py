"""One mapping, executed by the carrier and by the oracle."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

from router.compiler.checked import CheckedRoute, CheckedSubscription, Target
from router.compiler.expressions import Scope, check
from router.compiler.expressions.kinds import UINT32, ListKind
from router.compiler.expressions.tree import COUNT, INDEX, ITEM, Node, Variable
from router.compiler.lowering import lower_table
from router.compiler.mapping import build
from router.compiler.plan import Record
from router.errors import Located
from router.rehearsal.cdr import deserialize
from router.table.model.expressions import FieldMap
from router.table.model.targets import Destination, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase
from tests.carrier.delivering import Delivering
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN, context_of, outcome, written
from tests.compiler.judging import Answer, Misfit, Verdict, published, sent, verdict
from tests.compiler.machine import FAILURES
from tests.compiler.payloads import Wire
from tests.oracles.reference_expressions import Context, meaning_of
from tests.oracles.reference_kinds import Listing, Whole

TOPIC = "topic"


@dataclass(frozen=True)
class Mapping:
    """`carrier` and `oracle` take a message and return a list with the resulting messages.

    The oracle raises one of FAILURES for a message that cannot be read. The carrier reads only the fields it needs.
    """

    carrier: Callable[[bytes], list[Answer]]
    oracle: Callable[[bytes], list[Verdict]]

    def check(self, message: bytes) -> list[Answer]:
        """The carrier's result, checked against the oracle."""
        made, verdicts = self.carrier(message), self.oracle(message)
        allowed = [judged.allows(each) for judged, each in zip(verdicts, made, strict=True)]
        assert all(allowed), f"{made}, not {[*map(str, verdicts)]}"
        return made

    def check_damaged(self, message: bytes) -> list[Answer]:
        """The same for a message that the oracle may be unable to read."""
        return self.carrier(message) if outcome(lambda: self.oracle(message)) is FAILURES else self.check(message)


def to_ros(
    functions: ctypes.CDLL,
    wire: Wire,
    case: PayloadCase,
    fields: FieldMap,
    target: MessageType,
    ros_types: tuple[MessageType, ...] = (),
) -> Mapping:
    """From a payload to the message of a topic. Raises Misfit or ExpressionError."""
    enums = tuple(wire[0].enums.values())
    plan = _plan(fields, target, Scope(case.type, enums, ros_types))
    checked = Target(Topic(Located(TOPIC, SPAN), SPAN), None, target, None, plan)
    lowered, findings = lower_table([CheckedRoute(_route(), case, (checked,))])
    if findings:
        raise Misfit(findings)
    carrier = Delivering(functions, lowered.to_topics["route"], RECEIVED_AT, SOURCE)

    def oracle(payload: bytes) -> list[Verdict]:
        context = context_of(case.message_class.FromString(payload), case.type, enums, ros_types)
        return [verdict(partial(published, target, fields, context), None, context)]

    return Mapping(lambda payload: [each.got for each in carrier.datagram(payload)], oracle)


def from_ros(
    functions: ctypes.CDLL,
    wire: Wire,
    case: PayloadCase,
    fields: FieldMap,
    source: MessageType,
    when: str = "",
    for_each: str = "",
) -> Mapping:
    """From a ROS message to envelopes. Raises Misfit or ExpressionError."""
    enums = tuple(wire[0].enums.values())
    scope = Scope(source, enums, ())
    elements = check(written(for_each), scope) if for_each else None
    if elements is not None:
        assert isinstance(elements.kind, ListKind)
        assert elements.kind.element is not None
        names: dict[str, Node] = {ITEM: Variable(elements.kind.element, SPAN, ITEM)}
        names |= {name: Variable(UINT32, SPAN, name) for name in (INDEX, COUNT)}
        scope = Scope(source, enums, (), names)
    condition = check(written(when), scope) if when else None
    plan = _plan(fields, case.type, scope, scope.names.get(ITEM))
    checked = Target(Destination(Located("board", SPAN), SPAN), plan=plan, when=condition)
    feed = CheckedSubscription(Topic(Located(SOURCE, SPAN), SPAN), source, None, elements, None, (checked,))
    lowered, findings = lower_table([CheckedRoute(_route(), case, subscriptions=(feed,))])
    if findings:
        raise Misfit(findings)
    carrier = Delivering(functions, lowered.from_ros[SOURCE][0], RECEIVED_AT, "not of ROS")

    def oracle(message: bytes) -> list[Verdict]:
        given = written(when) if when else None
        contexts = _contexts(context_of(deserialize(source, message), source, enums), for_each)
        return [verdict(partial(sent, wire, case, fields, each), given, each) for each in contexts]

    return Mapping(lambda message: [each.got for each in carrier.from_ros(message)], oracle)


def _contexts(context: Context, for_each: str) -> list[Context]:
    """The context of the message, or of each element."""
    if not for_each:
        return [context]
    meaning = meaning_of(written(for_each), context)
    assert isinstance(meaning.kind, Listing)
    assert meaning.kind.element is not None
    elements, element = meaning.give(context), meaning.kind.element
    number = Whole(0, (1 << 32) - 1)
    count = len(elements), number
    return [
        replace(context, names={ITEM: (each, element), INDEX: (index, number), COUNT: count})
        for index, each in enumerate(elements)
    ]


def _plan(fields: FieldMap, target: MessageType, scope: Scope, whole: Node | None = None) -> Record:
    mapping = build(fields, target, scope, SPAN, whole)
    if mapping.findings:
        raise Misfit(mapping.findings)
    return mapping.plan


def _route() -> Any:
    return SimpleNamespace(name="route", ttl=None, ignore=None, span=SPAN)

"""Messages as the generated handlers and as the carrier make them of others: bytes out, or the reason of a refusal."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from router.compiler.cdr import CdrReads, write_message
from router.compiler.checked import CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.expressions import Scope, check
from router.compiler.expressions.kinds import UINT32, ListKind
from router.compiler.expressions.tree import COUNT, INDEX, ITEM, Node, Variable, paths_in
from router.compiler.lowering import lower_table
from router.compiler.mapping import build
from router.compiler.namespace import MAPPING_FAILURES, NAMESPACE
from router.compiler.plan import Record, expressions
from router.compiler.python import NO_VALUES, render
from router.compiler.source import Source
from router.errors import Located, NonFiniteError
from router.table.model import Destination, FieldMap, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase
from tests.carrier.delivering import FILTERED, Delivering
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN, written
from tests.compiler.payloads import Wire
from tests.oracles.python_engine.payload import write_envelope

TOPIC = "topic"
MAPPING_ERROR, NON_FINITE = "mapping_error", "non_finite"

Made = list["bytes | str"]
"""Of each message what is made of it, or why nothing is: one, but for `for_each`."""

Plane = Callable[[bytes], Made]


class Misfit(Exception):
    """What is wrong with a mapping."""


def to_ros(
    functions: ctypes.CDLL,
    wire: Wire,
    case: PayloadCase,
    fields: FieldMap,
    target: MessageType,
    when: str = "",
    ros_types: tuple[MessageType, ...] = (),
) -> tuple[Plane, Plane]:
    """The message of a topic, of a payload: by Python and by the carrier. Raises Misfit or ExpressionError."""
    schema, envelope = wire
    scope = Scope(case.type, tuple(schema.enums.values()), ros_types)
    condition = check(written(when), scope) if when else None
    plan = _plan(fields, target, scope)
    checked = CheckedTarget(Topic(Located(TOPIC, SPAN), SPAN), None, target, condition, plan)
    route = CheckedRoute(_route(), case, (checked,))
    lowered, findings = lower_table([route], envelope)
    if findings:
        raise Misfit(findings)
    carrier = Delivering(functions, lowered.to_topics["route"], RECEIVED_AT, SOURCE)

    def by_carrier(payload: bytes) -> Made:
        return [outcome.got for outcome in carrier.datagram(payload, is_single=True)]

    out = Source()
    with out.block("def make(m, source, received_at):", SPAN):
        _filtered(out, condition)
        out.line(f"yield {write_message(out, plan, 'it')}", SPAN)
    parse = case.message_class.FromString
    make = _function(out)
    return lambda payload: _outcomes(lambda: make(parse(payload), SOURCE, RECEIVED_AT)), by_carrier


def from_ros(
    functions: ctypes.CDLL,
    wire: Wire,
    case: PayloadCase,
    fields: FieldMap,
    source: MessageType,
    when: str = "",
    for_each: str = "",
) -> tuple[Plane, Plane]:
    """The envelopes of a message from ROS: by Python and by the carrier. Raises Misfit or ExpressionError."""
    schema, envelope = wire
    scope = Scope(source, tuple(schema.enums.values()), ())
    elements = check(written(for_each), scope) if for_each else None
    if elements is not None:
        assert isinstance(elements.kind, ListKind)
        assert elements.kind.element is not None
        names: dict[str, Node] = {ITEM: Variable(elements.kind.element, SPAN, ITEM)}
        names |= {name: Variable(UINT32, SPAN, name) for name in (INDEX, COUNT)}
        scope = Scope(source, tuple(schema.enums.values()), (), names)
    condition = check(written(when), scope) if when else None
    plan = _plan(fields, case.type, scope, scope.names.get(ITEM))
    checked = CheckedTarget(Destination(Located("board", SPAN), SPAN), plan=plan, when=condition)
    feed = CheckedSubscription(Topic(Located(SOURCE, SPAN), SPAN), source, None, elements, None, (checked,))
    lowered, findings = lower_table([CheckedRoute(_route(), case, subscriptions=(feed,))], envelope)
    if findings:
        raise Misfit(findings)
    carrier = Delivering(functions, lowered.from_ros[SOURCE][0], RECEIVED_AT, "not of ROS")

    def by_carrier(message: bytes) -> Made:
        return [outcome.got for outcome in carrier.from_ros(message)]

    out = Source()
    nodes = [*expressions(plan), *(each for each in (condition, elements) if each is not None)]
    reads = CdrReads(source, (path for node in nodes for path in paths_in(node)))
    with out.block("def make(cdr, source, received_at):", SPAN):
        reads.write(out, SPAN)
        if elements is None:
            _sent(out, plan, case, condition, reads)
        else:
            out.line(f"elements = {out.expression(render(elements, reads.values))}", SPAN)
            out.line("count = len(elements)", SPAN)
            with out.block("for index, item in enumerate(elements):", SPAN):
                with out.block("try:", SPAN):
                    _sent(out, plan, case, condition, reads)
                with out.block("except FAILURES as error:", SPAN):
                    out.line("yield error", SPAN)
    make = _function(out)

    return lambda message: _outcomes(lambda: make(message, SOURCE, RECEIVED_AT)), by_carrier


def _plan(fields: FieldMap, target: MessageType, scope: Scope, whole: Node | None = None) -> Record:
    mapping = build(fields, target, scope, SPAN, whole)
    if mapping.findings:
        raise Misfit(mapping.findings)
    return mapping.plan


def _route() -> Any:
    return SimpleNamespace(name="route", ttl=None, ignore=None, span=SPAN)


def _filtered(out: Source, condition: Node | None, reads: CdrReads | None = None) -> None:
    if condition is None:
        return
    with out.block(f"if not {out.expression(render(condition, reads.values if reads else NO_VALUES))}:", SPAN):
        out.line("yield None", SPAN)
        out.line("break" if reads else "return", SPAN)


def _sent(out: Source, plan: Record, case: PayloadCase, condition: Node | None, reads: CdrReads) -> None:
    with out.block("while True:", SPAN):
        _filtered(out, condition, reads)
        out.line(f"yield {write_envelope(out, plan, case, 'it', reads.values)}", SPAN)
        out.line("break", SPAN)


def _function(out: Source) -> Callable[..., Any]:
    namespace: dict[str, Any] = {**NAMESPACE, **out.constants, "FAILURES": MAPPING_FAILURES}
    exec(out.compile("table.yaml"), namespace)  # noqa: S102 - what is tested
    function: Callable[..., Any] = namespace["make"]
    return function


def _outcomes(make: Callable[[], Any]) -> Made:
    made: Made = []
    try:
        for each in make():
            made.append(FILTERED if each is None else _reason(each) if isinstance(each, Exception) else bytes(each))
    except MAPPING_FAILURES as error:
        made.append(_reason(error))
    return made


def _reason(error: BaseException) -> str:
    return NON_FINITE if isinstance(error, NonFiniteError) else MAPPING_ERROR

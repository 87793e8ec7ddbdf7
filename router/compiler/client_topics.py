"""Checks what a gateway lets in: the topics that clients publish on, their types, and the deadmen behind them."""

from __future__ import annotations

import struct
from typing import Any

from router.compiler.cdr import write_message
from router.compiler.checked import CheckedInbound
from router.compiler.deadmen import constant_plan, timing_findings
from router.compiler.lookup import Lookup
from router.compiler.namespace import NAMESPACE
from router.compiler.plan import Record
from router.compiler.source import Source
from router.compiler.topics import qos_findings, resolved, topic_name_finding
from router.errors import Code, MappingError
from router.table.model import Gateway, Inbound, InboundDeadman
from router.types.model import MessageType


def check_client_topics(lookup: Lookup, gateway: Gateway) -> tuple[CheckedInbound, ...]:
    """Those of a gateway whose types exist."""
    found: dict[str, CheckedInbound | None] = {}
    for inbound in gateway.inbound:
        name = resolved(inbound.topic.topic.value, lookup.table.node)
        if name in found:
            message = f"'{name}' is let in twice"
            lookup.report(inbound.topic.topic.span, Code.BAD_VALUE, message, "name it once")
        found[name] = _checked(lookup, inbound, name)
    return tuple(checked for checked in found.values() if checked)


def _checked(lookup: Lookup, inbound: Inbound, name: str) -> CheckedInbound | None:
    findings = (topic_name_finding(inbound.topic), *qos_findings(inbound.topic, publishes=True))
    lookup.findings += [finding for finding in findings if finding]
    ros_type = lookup.ros_type(inbound.topic)
    deadman = inbound.deadman
    if deadman is not None:
        max_rate = inbound.max_rate.value if inbound.max_rate else None
        lookup.findings += timing_findings(deadman, max_rate, "messages")
    if ros_type is None:
        return None
    return CheckedInbound(inbound, name, ros_type, _stop(lookup, deadman, ros_type) if deadman else None)


def _stop(lookup: Lookup, deadman: InboundDeadman, ros_type: MessageType) -> bytes | None:
    """What the deadman publishes, as CDR bytes."""
    span = deadman.fields.span
    plan = constant_plan(lookup, deadman.fields, ros_type, span, ros_type)
    if plan is None:
        return None
    try:
        return _constant_message(plan)
    except (MappingError, ArithmeticError, LookupError, ValueError, struct.error) as error:
        lookup.report(span, Code.BAD_VALUE, f"this message cannot be built: {error}")
        return None


def _constant_message(plan: Record) -> bytes:
    """The CDR bytes of a plan whose expressions have no message to look at."""
    out = Source()
    with out.block("def build():", plan.span):
        out.line(f"return {write_message(out, plan, 'constant')}", plan.span)
    namespace: dict[str, Any] = {**NAMESPACE, **out.constants}
    exec(out.compile(plan.span.file), namespace)  # noqa: S102 - code that we made of a checked plan
    return bytes(namespace["build"]())

"""What a protobuf message asks of its plan as a whole: at most one member of a oneof, every required field.

ROS messages ask nothing of the kind. Knows neither expressions nor how plans are written.
"""

from __future__ import annotations

from collections.abc import Iterator

from router.compiler.plan import Each, Items, Plan, Record, Unset
from router.errors import Code, Diagnostic


def presence_findings(plan: Plan) -> Iterator[Diagnostic]:
    match plan:
        case Record():
            yield from _oneof_findings(plan)
            yield from _required_findings(plan)
            for _, member in plan.members:
                yield from presence_findings(member)
        case Items():
            for item in plan.items:
                yield from presence_findings(item)
        case Each():
            yield from presence_findings(plan.element)


def _oneof_findings(plan: Record) -> Iterator[Diagnostic]:
    first: dict[str, str] = {}
    for member, made in plan.members:
        if member.oneof is None or isinstance(made, Unset):
            continue
        other = first.setdefault(member.oneof, member.name)
        if other != member.name:
            message = f"'{other}' and '{member.name}' are of one oneof, '{member.oneof}', and exclude each other"
            yield Diagnostic(plan.span, Code.DUPLICATE_FIELD, message, "map one of them, by hand and without `auto`")


def _required_findings(plan: Record) -> Iterator[Diagnostic]:
    for member, made in plan.members:
        if member.is_required and isinstance(made, Unset):
            message = f"nothing fills '{member.name}', without which there is no {plan.type}"
            yield Diagnostic(plan.span, Code.MISSING_KEY, message, "map it")

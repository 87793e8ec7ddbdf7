"""From a checked value to the plan of the field that it fills: messages field by field, lists element by element.

Whether a scalar fits is for `scalars` to say. Every function raises Finding where the value does not fit.
"""

from __future__ import annotations

import ast

from router.compiler import scalars
from router.compiler.expressions import Finding, Scope, Typed
from router.compiler.implementations import NS_PER_SECOND
from router.compiler.kinds import OCTET, BytesKind, Kind, ListKind, MessageKind, TimeKind, kind_of
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.compiler.syntax import load
from router.errors import Code, SourceSpan
from router.types.model import Field, List, MessageType, Type

_TIMES = frozenset({"builtin_interfaces/msg/Time", "google.protobuf.Timestamp"})
"""Messages that a time fills: whole seconds, and nanoseconds that are never negative."""


def convert(value: Typed, target: Type, scope: Scope) -> Plan:
    if isinstance(target, MessageType):
        return _to_message(value, target, scope)
    if isinstance(target, List):
        return _to_list(value, target, scope)
    if isinstance(value.kind, MessageKind) and len(value.kind.type.fields) == 1:
        (only,) = value.kind.type.fields
        return convert(scope.field_of(value, only, value.span), target, scope)
    return Leaf(target, scalars.converted(value, target), value.span)


def same_named(holder: Typed, member: Field, scope: Scope) -> Typed | None:
    """The field of a message that is called as `member` is, None when `holder` has none."""
    found = holder.kind.type.field(member.name) if isinstance(holder.kind, MessageKind) else None
    return scope.field_of(holder, found, holder.span) if found else None


def unset(member: Field, span: SourceSpan) -> Unset:
    return Unset(member.type, member.default, span)


# messages


def _to_message(value: Typed, target: MessageType, scope: Scope) -> Plan:
    if isinstance(value.kind, TimeKind) and target.name in _TIMES:
        return _to_time(value, target)
    if isinstance(value.kind, MessageKind):
        return _to_same_named(value, value.kind.type, target, scope)
    if len(target.fields) == 1:
        (only,) = target.fields
        return Record(target, ((only, convert(value, only.type, scope)),), value.span)
    raise scalars.mismatch(value, target, "map its fields one by one")


def _to_time(value: Typed, target: MessageType) -> Record:
    def part(member: Field, op: ast.operator) -> tuple[Field, Plan]:
        made = ast.BinOp(value.node, op, ast.Constant(NS_PER_SECOND))
        return member, Leaf(member.type, Typed.at(value.span, value.kind, made).node, value.span)

    sec, nanosec = target.fields
    return Record(target, (part(sec, ast.FloorDiv()), part(nanosec, ast.Mod())), value.span)


def _to_same_named(value: Typed, source: MessageType, target: MessageType, scope: Scope) -> Record:
    members: list[tuple[Field, Plan]] = []
    for member in target.fields:
        given = same_named(value, member, scope)
        members.append((member, convert(given, member.type, scope) if given else unset(member, value.span)))
    if target.fields and not any(source.field(member.name) for member in target.fields):
        raise scalars.mismatch(value, target, "they have no field name in common")
    return Record(target, tuple(members), value.span)


# lists


def _to_list(value: Typed, target: List, scope: Scope) -> Plan:
    if value.items is not None:
        _want_length(value, target, len(value.items))
        return Items(target, tuple(convert(item, target.element, scope) for item in value.items), value.span)
    element_kind, length = _elements(value.kind)
    if element_kind is None:
        raise scalars.mismatch(value, target, "write a list, [a, b]")
    if length is not None:
        _want_length(value, target, length)
    variable = scope.reads.loop()
    element = Typed.at(value.span, element_kind, load(variable))
    return Each(target, value.node, variable, convert(element, target.element, scope), value.span)


def _elements(kind: Kind) -> tuple[Kind | None, int | None]:
    """The kind and number of a list's elements, each None where there is none or it is not known."""
    if isinstance(kind, BytesKind):
        return kind_of(OCTET), None
    return (kind.element, kind.length) if isinstance(kind, ListKind) else (None, None)


def _want_length(value: Typed, target: List, length: int) -> None:
    if target.length is not None and length != target.length:
        raise Finding(value.span, Code.TYPE_MISMATCH, f"{target} takes {target.length} elements, not {length}")
    if target.bound is not None and length > target.bound:
        raise Finding(value.span, Code.OUT_OF_RANGE, f"{target} takes at most {target.bound} elements, not {length}")

"""What fills a target: `fields:` and the target's type become a plan, one node for every field.

A plan says where each value comes from and that it fits; how it is written (CDR, protobuf) is for
others. Every entry that is wrong is a finding, and the rest of the mapping is still checked.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Union

from router.compiler import conversion
from router.compiler.expressions import Finding, Scope, Typed, attribute, check, placed, read
from router.compiler.kinds import (
    BytesKind,
    ListKind,
    MessageKind,
    TimeKind,
    kind_of,
)
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean
from router.table.model import Expression, FieldEntry, FieldMap
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Leaf:
    """One scalar. `constant` is its value where that is known now, else `node` computes it."""

    type: Type
    node: ast.expr
    span: SourceSpan

    @property
    def constant(self) -> object:
        return self.node.value if isinstance(self.node, ast.Constant) else None


@dataclass(frozen=True, slots=True)
class Record:
    """A message: a plan for each of its fields, in order."""

    type: MessageType
    members: tuple[tuple[Field, Plan], ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Items:
    """A list whose elements are each known by themselves."""

    type: List
    items: tuple[Plan, ...]
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Each:
    """A list made of a list (or bytes): `element` fills one element from the one called `variable`."""

    type: List
    values: ast.expr
    variable: str
    element: Plan
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Unset:
    """A field that nothing fills: it keeps its default, or in protobuf stays absent."""

    type: Type
    default: object
    span: SourceSpan


Plan = Union[Leaf, Record, Items, Each, Unset]


@dataclass(frozen=True, slots=True)
class Row:
    """One line of what a mapping came to, for people: target field and type, source text and kind."""

    target: str
    target_type: str
    expression: str
    kind: str
    automatic: bool


@dataclass(slots=True)
class FieldMapping:
    """The outcome: a plan, what it came to, and what is wrong with it."""

    plan: Record
    rows: list[Row] = field(default_factory=list)
    findings: list[Diagnostic] = field(default_factory=list)


_Tree = dict[str, Union["_Tree", FieldEntry]]


def build(fields: FieldMap | None, target: MessageType, scope: Scope, span: SourceSpan) -> FieldMapping:
    """The mapping of a message of type `target`. `span` is blamed for what no entry can be."""
    builder = _Builder(scope, fields.span if fields else span)
    tree = builder.tree(fields.entries if fields else (), target)
    automatic = Typed(MessageKind(scope.message), ast.Name(scope.locals.message, ast.Load()), span, path=())
    plan = builder.record(target, tree, automatic if fields and fields.auto else None, "")
    outcome = FieldMapping(plan, builder.rows, builder.findings)
    if target.fields and not builder.rows and not builder.findings:
        hint = "map its fields, or say `fields: auto`"
        if fields and fields.auto:
            hint = f"{scope.message} and {target} have no field name in common; map the fields by hand"
        outcome.findings.append(Diagnostic(builder.span, Code.NOTHING_MAPPED, f"nothing fills {target}", hint))
    return outcome


class _Builder:
    def __init__(self, scope: Scope, span: SourceSpan) -> None:
        self.scope = scope
        self.span = span
        self.rows: list[Row] = []
        self.findings: list[Diagnostic] = []
        self.variables = 0

    def tree(self, entries: Sequence[FieldEntry], target: MessageType) -> _Tree:
        """The entries by field, those with unknown fields or given twice reported and left out."""
        root: _Tree = {}
        for entry in entries:
            if self._resolves(entry, target):
                self._insert(root, entry)
        return root

    def _resolves(self, entry: FieldEntry, target: MessageType) -> bool:
        holder: Type = target
        for name, span in zip(entry.path, entry.path_spans, strict=True):
            if not isinstance(holder, MessageType):
                message, hint = f"a {holder} has no fields", "give the whole of it one value"
                self.findings.append(Diagnostic(span, Code.UNKNOWN_FIELD, message, hint))
                return False
            member = holder.field(name)
            if member is None:
                hint = did_you_mean(name, [member.name for member in holder.fields])
                self.findings.append(Diagnostic(span, Code.UNKNOWN_FIELD, f"{holder} has no field '{name}'", hint))
                return False
            holder = member.type
        return True

    def _insert(self, tree: _Tree, entry: FieldEntry) -> None:
        for name in entry.path[:-1]:
            inner = tree.setdefault(name, {})
            if isinstance(inner, FieldEntry):
                self._twice(entry)
                return
            tree = inner
        if entry.path[-1] in tree:
            self._twice(entry)
        else:
            tree[entry.path[-1]] = entry

    def _twice(self, entry: FieldEntry) -> None:
        path = ".".join(entry.path)
        self.findings.append(Diagnostic(entry.path_spans[-1], Code.DUPLICATE_FIELD, f"'{path}' is filled twice"))

    def record(self, target: MessageType, tree: _Tree, automatic: Typed | None, prefix: str) -> Record:
        members = [(member, self._member(member, tree.get(member.name), automatic, prefix)) for member in target.fields]
        return Record(target, tuple(members), self.span)

    def _member(self, member: Field, given: _Tree | FieldEntry | None, automatic: Typed | None, prefix: str) -> Plan:
        path = prefix + member.name
        source = self._same_named(automatic, member.name)
        if isinstance(given, FieldEntry):
            return self._explicit(member, given, path)
        if given is not None:
            assert isinstance(member.type, MessageType)  # noqa: S101 - _resolves() saw to it
            inner = source if source and isinstance(source.kind, MessageKind) else None
            return self.record(member.type, given, inner, f"{path}.")
        if source is not None:
            return self._automatic(member, source, path)
        return Unset(member.type, member.default, self.span)

    def _same_named(self, holder: Typed | None, name: str) -> Typed | None:
        if holder is None or not isinstance(holder.kind, MessageKind):
            return None
        member = holder.kind.type.field(name)
        return self._field_of(holder, member) if member else None

    def _field_of(self, holder: Typed, member: Field) -> Typed:
        if holder.path is not None:
            return read(self.scope, holder.path, member, holder.span)
        return Typed(kind_of(member.type), placed(attribute(holder.node, member.name), holder.span), holder.span)

    def _explicit(self, member: Field, entry: FieldEntry, path: str) -> Plan:
        try:
            typed = check(entry.value, self.scope, member.type)
            plan = self.convert(typed, member.type)
        except Finding as finding:
            self.findings.append(finding.diagnostic)
            return Unset(member.type, member.default, entry.value.span)
        text = _text(entry.value)
        self.rows.append(Row(path, str(member.type), text, str(typed.kind), automatic=False))
        return plan

    def _automatic(self, member: Field, source: Typed, path: str) -> Plan:
        try:
            plan = self.convert(source, member.type)
        except Finding as finding:
            found = finding.diagnostic
            message = f"auto cannot fill '{path}': {found.message}"
            self.findings.append(Diagnostic(self.span, found.code, message, f"map '{path}' by hand: {found.hint}"))
            return Unset(member.type, member.default, self.span)
        self.rows.append(Row(path, str(member.type), path, str(source.kind), automatic=True))
        return plan

    # conversion of one checked value to the type of the field that it fills

    def convert(self, value: Typed, target: Type) -> Plan:
        """Raises Finding."""
        kind = value.kind
        if isinstance(target, MessageType):
            return self._to_message(value, target)
        if isinstance(target, List):
            return self._to_list(value, target)
        if isinstance(kind, MessageKind) and len(kind.type.fields) == 1:
            return self.convert(self._field_of(value, kind.type.fields[0]), target)
        return Leaf(target, conversion.scalar(value, target), value.span)

    def _to_message(self, value: Typed, target: MessageType) -> Plan:
        kind = value.kind
        if isinstance(kind, TimeKind) and target.name == "builtin_interfaces/msg/Time":
            return self._to_time(value, target)
        if isinstance(kind, MessageKind):
            return self._to_same_named(value, kind.type, target)
        if len(target.fields) == 1:
            member = target.fields[0]
            return Record(target, ((member, self.convert(value, member.type)),), value.span)
        raise conversion.mismatch(value, target, "map its fields one by one")

    def _to_time(self, value: Typed, target: MessageType) -> Record:
        sec, nanosec = target.fields
        parts: list[tuple[Field, Plan]] = []
        for member, op in (sec, ast.FloorDiv()), (nanosec, ast.Mod()):
            node = placed(ast.BinOp(value.node, op, ast.Constant(NS)), value.span)
            parts.append((member, Leaf(member.type, node, value.span)))
        return Record(target, tuple(parts), value.span)

    def _to_same_named(self, value: Typed, source: MessageType, target: MessageType) -> Record:
        names = {member.name for member in source.fields}
        members: list[tuple[Field, Plan]] = []
        for member in target.fields:
            inner = self._same_named(value, member.name)
            plan = self.convert(inner, member.type) if inner else Unset(member.type, member.default, value.span)
            members.append((member, plan))
        if target.fields and not names & {member.name for member in target.fields}:
            raise conversion.mismatch(value, target, "they have no field name in common")
        return Record(target, tuple(members), value.span)

    def _to_list(self, value: Typed, target: List) -> Plan:
        if value.items is not None:
            conversion.want_length(value, target, len(value.items))
            return Items(target, tuple(self.convert(item, target.element) for item in value.items), value.span)
        kind = value.kind
        if isinstance(kind, BytesKind):
            kind = ListKind(kind_of(Int(8, signed=False)))
        if not isinstance(kind, ListKind) or kind.element is None:
            raise conversion.mismatch(value, target, "write a list, [a, b]")
        if kind.length is not None:
            conversion.want_length(value, target, kind.length)
        self.variables += 1
        variable = f"item_{self.variables}"
        element = Typed(kind.element, placed(ast.Name(variable, ast.Load()), value.span), value.span)
        return Each(target, value.node, variable, self.convert(element, target.element), value.span)


def zero(declared: Type) -> object:
    """What ROS gives a scalar field without a declared default."""
    match declared:
        case Bool():
            return False
        case Float():
            return 0.0
        case String():
            return ""
        case _:
            return 0


def _text(expression: Expression) -> str:
    """As the table has it, on one line."""
    if expression.items is not None:
        return f"[{', '.join(map(_text, expression.items))}]"
    return " ".join(expression.text.split())

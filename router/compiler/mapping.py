"""Mappings: `fields` and the target's type become a plan with a node for every field.

Every invalid entry is a finding, and the rest of the mapping is still checked.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Union

from router.compiler.conversion import convert, elements_of, how_to_fill, require_length, same_named, unset
from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.kinds import MessageKind, element_of
from router.compiler.expressions.tree import ListLiteral, Node
from router.compiler.plan import Each, Items, Plan, Record, Unset
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean, nearest, one_of
from router.table.model.expressions import Choices, Elements, Expression, FieldEntry, FieldMap
from router.table.nodes import TEXT
from router.types.model import Field, List, MessageType, String, Type
from router.types.paths import ways

_FRAME = re.compile(r"/?\w+(?:[/-]\w+)+|/\w+")
"""Names of frames that parse as a division or a difference: `base/imu_link`, `imu-link`."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a mapping for `explain`: target field and type, source text and kind."""

    target: str
    target_type: str
    expression: str
    kind: str
    automatic: bool


@dataclass(slots=True)
class FieldMapping:
    """A checked mapping: its plan, rows for `explain`, and findings."""

    plan: Record
    rows: list[Row] = field(default_factory=list)
    findings: list[Diagnostic] = field(default_factory=list)


_ONE_VALUE = "assign one value to it, or choose one: {map: FIELD, VALUE: ..., else: ...}"
_MISSPELT = 0.9
"""Minimum similarity of a name that can only be a misspelt field of the target."""


def _of_one_key(spans: Sequence[SourceSpan], depth: int) -> tuple[int, int]:
    """Return the indexes of the first and last name of the key, such as `a.b.c`, that has the name at `depth`."""
    first = last = depth
    while first > 0 and spans[first - 1].end_column + 1 == spans[first].column:
        first -= 1
    while last + 1 < len(spans) and spans[last].end_column + 1 == spans[last + 1].column:
        last += 1
    return first, last


def _nested(entry: FieldEntry, target: MessageType) -> FieldEntry:
    """Return the entry, or for `{text: value}` and a message with a field `text`, the entry of that field."""
    holder: Type | None = target
    for name in entry.path:
        member = holder.field(name) if isinstance(holder, MessageType) else None
        holder = member.type if member else None
    text = None if isinstance(entry.value, Elements) else _text_field(entry.value, holder, entry.path, entry.path_spans)
    return text or entry


def _text_field(
    value: Expression, holder: Type | None, path: tuple[str, ...] = (), spans: tuple[SourceSpan, ...] = ()
) -> FieldEntry | None:
    """Return `{text: value}` for the message `holder` at `path` as the entry of its field `text`, if it has one."""
    if not value.literal or not isinstance(holder, MessageType) or holder.field(TEXT) is None:
        return None
    return FieldEntry((*path, TEXT), (*spans, value.span), replace(value, literal=False))


@dataclass(slots=True)
class _Branch:
    """A message of the target that entries fill: entries for its fields, branches for messages in it."""

    type: MessageType
    given: dict[str, Union[FieldEntry, _Branch]] = field(default_factory=dict)


def build(
    fields: FieldMap | None,
    target: MessageType,
    scope: Scope,
    span: SourceSpan,
    whole: Node | None = None,
    ros_type: MessageType | None = None,
) -> FieldMapping:
    """Map a message of type `target`. `span` is the position of findings that concern no single entry.

    `auto` takes fields of `whole`, or of the source message if that is None. Without `fields`, the mapping is `auto`,
    and every field of `ros_type`, the source or the target, needs a field of the same name on the other side.
    """
    if fields is None:
        outcome = build(FieldMap(span, auto=True, entries=()), target, scope, span, whole)
        left = _left_out(ros_type, outcome.rows) if ros_type and not outcome.findings else []
        if left:
            names = ", ".join(f"'{name}'" for name in left[:_MOST_NAMES]) + ", ..." * (len(left) > _MOST_NAMES)
            source = whole.kind.type if whole and isinstance(whole.kind, MessageKind) else scope.message
            other = source if ros_type == target else target
            message = f"without 'fields', every field of {ros_type} needs a counterpart, but {other} has no {names}"
            hint = "map the fields, or write `fields: auto` to leave out those without a counterpart"
            outcome.findings.append(Diagnostic(span, Code.NOTHING_MAPPED, message, hint))
        return outcome
    builder = _Builder(scope, fields.span, "item." if whole else "")
    given = builder.sort(fields.entries, target)
    automatic = (whole or scope.whole_message(span)) if fields.auto else None
    plan = builder.record(given, automatic, "")
    outcome = FieldMapping(plan, builder.rows, builder.findings or list(presence_findings(plan)))
    if target.fields and not builder.rows and not outcome.findings:
        hint = "map its fields"
        if _may_be_automatic(scope, target):
            hint += ", or write `fields: auto`"
        if automatic is not None:
            hint = f"map the fields by hand: {automatic.kind} and {target} have no field name in common"
        outcome.findings.append(Diagnostic(builder.span, Code.NOTHING_MAPPED, f"nothing fills {target}", hint))
    return outcome


def _may_be_automatic(scope: Scope, target: MessageType) -> bool:
    """Return whether `auto` would fill a field of the target."""
    return any(scope.message.field(member.name) for member in target.fields)


_MOST_NAMES = 4
"""Maximum number of fields that a finding lists."""


def _left_out(message: MessageType, rows: Sequence[Row]) -> list[str]:
    """Return the fields of `message` that are not in the rows of an automatic mapping."""
    named = {row.target for row in rows}
    return [
        path
        for path in _paths(message, "")
        if not any(path == target or path.startswith(f"{target}.") for target in named)
    ]


def _paths(message: MessageType, prefix: str) -> Iterator[str]:
    """Yield the paths of all fields that are not messages."""
    for member in message.fields:
        if isinstance(member.type, MessageType) and member.type.fields:
            yield from _paths(member.type, f"{prefix}{member.name}.")
        else:
            yield prefix + member.name


class _Builder:
    """Builds one mapping. `automatic` is the message whose fields fill those of the same name, or None.

    `origin` is the prefix of automatic fields in rows: `item.`, or empty for the source message.
    """

    def __init__(self, scope: Scope, span: SourceSpan, origin: str) -> None:
        self.scope = scope
        self.span = span
        self.origin = origin
        self.rows: list[Row] = []
        self.findings: list[Diagnostic] = []
        self._whole = set[tuple[str, ...]]()
        self._taken = set[tuple[str, ...]]()
        self._reported = set[tuple[tuple[str, ...], SourceSpan]]()

    # entries by field

    def sort(self, entries: Sequence[FieldEntry], target: MessageType) -> _Branch:
        """Return the entries by field. Unknown and duplicate fields are reported and left out."""
        root = _Branch(target)
        self._taken = {entry.path[: depth + 1] for entry in entries for depth in range(len(entry.path))}
        for entry in map(functools.partial(_nested, target=target), entries):
            if holders := self._holders(entry, target):
                self._insert(root, entry, holders)
        return root

    def _holders(self, entry: FieldEntry, target: MessageType) -> list[MessageType]:
        """Return the message types along the path of an entry, empty if it leads to no field."""
        holders: list[MessageType] = []
        holder: Type = target
        for depth, (name, span) in enumerate(zip(entry.path, entry.path_spans, strict=True)):
            if not isinstance(holder, MessageType):
                path = entry.path[:depth]
                if path not in self._whole:
                    self._whole.add(path)
                    message, hint = f"{holder} has no fields", _ONE_VALUE
                    if isinstance(holder, String):
                        hint = "write text as {text: WORD}"
                    elif isinstance(holder, List):
                        message = f"'{entry.path[depth - 1]}' is a list of {holder.element}, and a list has no fields"
                        hint = how_to_fill(holder, self.scope)
                    self.findings.append(Diagnostic(span, Code.UNKNOWN_FIELD, message, hint))
                return []
            member = holder.field(name)
            if member is None:
                self._unknown(entry, depth, holder)
                return []
            holders.append(holder)
            holder = member.type
        return holders

    def _unknown(self, entry: FieldEntry, depth: int, holder: MessageType) -> None:
        """Report that `holder` has no field with the name at `depth`. A key above several keys is reported once."""
        name, span = entry.path[depth], entry.path_spans[depth]
        if (entry.path[: depth + 1], span) in self._reported:
            return
        self._reported.add((entry.path[: depth + 1], span))
        free = [member.name for member in holder.fields if (*entry.path[:depth], member.name) not in self._taken]
        first, last = _of_one_key(entry.path_spans, depth)
        hint = did_you_mean(name, free or [member.name for member in holder.fields])
        if not nearest(name, free, _MISSPELT) and (meant := ways(holder, entry.path[depth:])):
            behind = sum(len(step) + 1 for step in entry.path[last + 1 :])
            before = "".join(f"{step}." for step in entry.path[first:depth])
            hint = one_of([before + way[: len(way) - behind] for way in meant])
            span = replace(entry.path_spans[first], end_column=entry.path_spans[last].end_column)
        self.findings.append(Diagnostic(span, Code.UNKNOWN_FIELD, f"{holder} has no field '{name}'", hint))

    def _insert(self, branch: _Branch, entry: FieldEntry, holders: Sequence[MessageType]) -> None:
        *way, last = entry.path
        for name, inner_type in zip(way, holders[1:], strict=True):
            inner = branch.given.setdefault(name, _Branch(inner_type))
            if isinstance(inner, FieldEntry):
                self._twice(entry)
                return
            branch = inner
        if branch.given.setdefault(last, entry) is not entry:
            self._twice(entry)

    def _twice(self, entry: FieldEntry) -> None:
        path = ".".join(entry.path)
        self.findings.append(
            Diagnostic(entry.path_spans[-1], Code.DUPLICATE_FIELD, f"'{path}' is filled twice", "remove one of the two")
        )

    # plans

    def record(self, branch: _Branch, automatic: Node | None, prefix: str) -> Record:
        members = [
            (member, self._member(member, branch.given.get(member.name), automatic, prefix))
            for member in branch.type.fields
        ]
        return Record(branch.type, tuple(members), self.span)

    def _member(self, member: Field, given: FieldEntry | _Branch | None, automatic: Node | None, prefix: str) -> Plan:
        path = prefix + member.name
        source = same_named(automatic, member) if automatic else None
        if isinstance(given, FieldEntry):
            return self._explicit(member.type, given.value, path) or unset(member, given.value.span)
        if given is not None:
            return self.record(given, source, f"{path}.")
        if source is not None:
            return self._automatic(member, source, path)
        return unset(member, self.span)

    def _explicit(self, target: Type, value: Expression | Elements, path: str) -> Plan | None:
        """Return the plan of a field or list element, or None after a finding."""
        if isinstance(value, Elements):
            return self._each(target, value, path)
        fields = [_fields_of(item, target) for item in value.items or ()]
        if any(fields):
            return self._elements(target, value, fields, path)
        try:
            typed = check(value, self.scope, target)
            plan = convert(typed, target, self.scope)
        except ExpressionError as error:
            finding = error.diagnostic
            if value.choices is not None and finding.span == value.span:
                finding = self._chosen_finding(target, value.choices) or finding
            if isinstance(target, String) and not value.literal and _FRAME.fullmatch(value.text):
                finding = replace(finding, hint=f"for text, write {{text: {value.text}}}")
            self.findings.append(finding)
            return None
        self.rows.append(Row(path, str(target), _text(value), str(typed.kind), automatic=False))
        return plan

    def _elements(self, target: Type, value: Expression, fields: Sequence[FieldMap | None], path: str) -> Items | None:
        """Fill a list of messages with the items of `value`, some of which are given by their `fields`."""
        if not isinstance(target, List) or not isinstance(target.element, MessageType):
            first = next(given.span for given in fields if given)
            message = f"cannot assign fields to {target}"
            self.findings.append(Diagnostic(first, Code.TYPE_MISMATCH, message, self._instead(target)))
            return None
        try:
            require_length(value.span, target, len(fields))
        except ExpressionError as error:
            self.findings.append(error.diagnostic)
        plans: list[Plan | None] = []
        for index, (item, given) in enumerate(zip(value.items or (), fields, strict=True)):
            inner = f"{path}[{index}]"
            if given is None:
                plans.append(self._explicit(target.element, item, inner))
            else:
                plans.append(self._element(target.element, given, inner))
        return Items(target, tuple(plan for plan in plans if plan is not None), value.span)

    def _instead(self, target: Type) -> str:
        """Return the hint for a list of fields that fills something else than a list of messages."""
        if isinstance(target, List):
            return how_to_fill(target, self.scope)
        return "write its fields without the brackets" if isinstance(target, MessageType) else _ONE_VALUE

    def _element(self, target: MessageType, fields: FieldMap, path: str) -> Record:
        builder = _Builder(self.scope, fields.span, self.origin)
        plan = builder.record(builder.sort(fields.entries, target), None, f"{path}.")
        self.rows += builder.rows
        self.findings += builder.findings
        return plan

    def _each(self, target: Type, given: Elements, path: str) -> Each | None:
        """Fill a list of messages with a mapping of each message of another list. Return None after a finding."""
        try:
            source = check(given.source, self.scope)
            into, message = _lists_of_messages(target, source)
            lists, element = elements_of(source, into, self.scope)
        except ExpressionError as error:
            self.findings.append(error.diagnostic)
            return None
        self.rows.append(Row(path, str(into), f"each of {_text(given.source)}", str(source.kind), automatic=False))
        inner = build(given.fields, message, self.scope.of_element(element), given.fields.span)
        self.rows += [replace(row, target=f"{path}[].{row.target}") for row in inner.rows]
        self.findings += inner.findings
        return Each(into, lists, inner.plan, given.span)

    def _chosen_finding(self, target: Type, choices: Choices) -> Diagnostic | None:
        """Return the finding for the first value of a map that does not fit the field."""
        values = [value for _, value in choices.values]
        for value in values if choices.otherwise is None else [*values, choices.otherwise]:
            try:
                convert(check(value, self.scope, target), target, self.scope)
            except ExpressionError as error:
                return error.diagnostic
        return None

    def _automatic(self, member: Field, source: Node, path: str) -> Plan:
        try:
            plan = convert(source, member.type, self.scope)
        except ExpressionError as error:
            finding = error.diagnostic
            message = f"auto cannot fill '{path}': {finding.message}"
            by_hand = "the other fields" if finding.code is Code.FORBIDDEN_EXPRESSION else f"'{path}'"
            self.findings.append(Diagnostic(self.span, finding.code, message, f"map {by_hand} by hand: {finding.hint}"))
            return unset(member, self.span)
        self.rows.append(Row(path, str(member.type), self.origin + path, str(source.kind), automatic=True))
        return plan


def _fields_of(item: Expression, target: Type) -> FieldMap | None:
    """Return the fields of a list element. `{text: value}` is the field `text` of a message that has one."""
    text = _text_field(item, target.element if isinstance(target, List) else None)
    return FieldMap(item.span, auto=False, entries=(text,)) if text else item.fields


def _lists_of_messages(target: Type, source: Node) -> tuple[List, MessageType]:
    """Return the target of `each`, and the type of its messages. Raises ExpressionError for another type or source."""
    if not isinstance(target, List) or not isinstance(target.element, MessageType):
        message = f"`each` fills a list of messages, not {target}"
        hint = "write the list itself" if isinstance(target, List) else "write its value itself"
        raise ExpressionError(source.span, Code.TYPE_MISMATCH, message, hint)
    if isinstance(source, ListLiteral):
        message, hint = (
            "`each` takes a list of the message, not one that is written out",
            "write its elements, [{FIELD: VALUE}]",
        )
        raise ExpressionError(source.span, Code.TYPE_MISMATCH, message, hint)
    if not isinstance(element_of(source.kind), MessageKind):
        message, hint = f"`each` takes a list of messages, not {source.kind}", "name a field that is a list of messages"
        raise ExpressionError(source.span, Code.TYPE_MISMATCH, message, hint)
    return target, target.element


def _text(expression: Expression) -> str:
    """Return an expression as the table has it, on one line."""
    if expression.choices is not None or expression.literal:
        return str(expression)
    if expression.items is not None:
        return f"[{', '.join(map(_text, expression.items))}]"
    return " ".join(expression.text.split())


def presence_findings(plan: Plan) -> Iterator[Diagnostic]:
    """Yield findings for messages with two members of one oneof, or without a required field."""
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
    for member, filled in plan.members:
        if member.oneof is None or isinstance(filled, Unset):
            continue
        other = first.setdefault(member.oneof, member.name)
        if other != member.name:
            message = f"'{other}' and '{member.name}' are members of the oneof '{member.oneof}' and exclude each other"
            yield Diagnostic(plan.span, Code.DUPLICATE_FIELD, message, "map only one of them, without `auto`")


def _required_findings(plan: Record) -> Iterator[Diagnostic]:
    for member, filled in plan.members:
        if member.is_required and isinstance(filled, Unset):
            message = f"nothing fills '{member.name}', which {plan.type} requires"
            yield Diagnostic(plan.span, Code.MISSING_KEY, message, "map it")

"""Fields of the envelope beside the payload, as `set` of an endpoint fills them in what the router makes for it.

They precede the payload. Constants are known bytes; what differs from message to message, `sequence` and `now`, has a
fixed place, which the carrier fills when it sends the message (`native/beside.h`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.compiler.compiled_table import Beside, Changing
from router.compiler.constants import fields_of
from router.compiler.expressions import ExpressionError, check
from router.compiler.expressions.functions import NS_PER_SECOND
from router.compiler.expressions.kinds import UINT64, FloatKind
from router.compiler.expressions.tree import ENVELOPE, Binary, Constant, Node, Operator, Variable, nodes_in
from router.compiler.mapping import Row, build
from router.compiler.plan import Plan, Record, Unset
from router.declared import BesideEncoding, BesideValue, Op
from router.errors import Code, FindingError
from router.table.model.endpoints import Endpoint
from router.table.model.expressions import Expression, FieldMap
from router.types.board_limits import BoardField, BoardLimits, BoardMessage, scalars
from router.types.descriptors import container, message_of
from router.types.model import Field, Float, Int, MessageType, Type
from router.types.paths import type_at
from router.types.protobuf import Envelope
from router.types.wire import GROUP, GROUP_END, LEN, encoding_of, varint

if TYPE_CHECKING:
    from router.compiler.lookup import Lookup

SEQUENCE, NOW = "sequence", "now"
"""The values that differ from message to message."""

_TIMESTAMP = "google.protobuf.Timestamp"
_YEAR_2100 = 4_102_444_800
"""In seconds since 1970. An integer must hold times until then."""
_NOTHING = MessageType("set")
"""The source message of the constants: a message without fields."""
_FORMS = f"write a constant, `{SEQUENCE}`, `{NOW}`, or a multiple such as `{NOW} * 1000`"


Path = tuple[str, ...]


def check_beside(lookup: Lookup) -> dict[str, Beside]:
    """Check `set` of all endpoints. Return what it fills, by endpoint; those with findings are left out."""
    checked = {}
    for endpoint in lookup.table.endpoints.values():
        if endpoint.beside is not None:
            try:
                beside = _Set(lookup, endpoint, endpoint.beside).checked()
            except FindingError as error:
                lookup.findings.append(error.diagnostic)
                continue
            if beside is not None:
                checked[endpoint.name] = beside
    return checked


@dataclass(frozen=True, slots=True)
class _Set:
    """Checks `set` of one endpoint."""

    lookup: Lookup
    endpoint: Endpoint
    fields: FieldMap

    @property
    def board(self) -> BoardLimits | None:
        return self.lookup.boards.get(self.endpoint.name)

    @property
    def _around(self) -> Envelope:
        return self.lookup.envelopes.to(self.endpoint.name)

    @property
    def _envelope(self) -> Descriptor:
        return self._around.message_class.DESCRIPTOR  # type: ignore[return-value]  # of upb

    def checked(self) -> Beside | None:
        """Return None after findings about constants. Raises FindingError for any other mistake."""
        lookup, envelope = self.lookup, self._around
        constants, changing, sources = [], dict[Path, Changing](), dict[str, Row]()
        if not envelope.beside.fields:
            message, hint = f"{envelope.name} has no fields beside the payload", "remove 'set'"
            if root := envelope.choice.root:
                message = f"{envelope.name} is the payload '{root}' itself, so no fields are beside it"
                hint = "fill its fields in `fields` of a route from ROS and in a deadman's `send`"
            raise FindingError(self.fields.span, Code.UNKNOWN_FIELD, message, hint)
        for entry in self.fields.entries:
            if entry.path[0] in envelope.numbers:
                message = f"'{entry.path[0]}' is a payload, not a field beside it"
                hint = f"the fields beside it are {', '.join(each.name for each in envelope.beside.fields) or 'none'}"
                raise FindingError(entry.path_spans[0], Code.UNKNOWN_FIELD, message, hint)
            written, target = entry.value, type_at(envelope.beside, entry.path)
            value = self._value(written) if isinstance(written, Expression) else None
            if value is None or target is None or not isinstance(written, Expression):
                constants.append(entry)
                continue
            changing |= self._changing(value, target, entry.path, written)
            in_place = "time_from_seconds(0)" if isinstance(target, MessageType) else "0"
            constants.append(replace(entry, value=replace(written, text=in_place)))
            name, kind = ".".join(entry.path), "time" if value.is_time else "number"
            sources[name] = Row(name, str(target), written.text, kind, automatic=False)
        scope = replace(lookup.scope(_NOTHING), given=())
        given = replace(self.fields, entries=tuple(constants))
        mapping = build(given, envelope.beside, scope, self.fields.span)
        if findings := [each for each in mapping.findings if each.code is not Code.NOTHING_MAPPED]:
            lookup.findings += findings
            return None
        data, filled_in = _written(mapping.plan, self._envelope, (), changing)
        self._require_fit(data)
        rows = [sources.get(row.target, row) for row in mapping.rows]
        named = tuple(replace(row, target=f"{ENVELOPE}.{row.target}") for row in rows)
        return Beside(data, tuple(filled_in), named, mapping.plan)

    # values that change

    def _value(self, expression: Expression) -> _Value | None:
        """Return the value of an entry if it changes; None for a constant, and for what `build` reports."""
        names: dict[str, Node] = {
            SEQUENCE: Variable(UINT64, expression.span, SEQUENCE),
            NOW: Variable(FloatKind(64), expression.span, NOW),
        }
        try:
            node = check(expression, replace(self.lookup.scope(_NOTHING, names=names), given=()))
        except ExpressionError:
            return None
        if not any(isinstance(each, Variable) for each in nodes_in(node)):
            return None
        value = _simple(node)
        if value is None:
            what = f"'{SEQUENCE}' and '{NOW}' are the only values here that differ from message to message"
            raise FindingError(expression.span, Code.FORBIDDEN_EXPRESSION, what, _FORMS)
        return value

    def _changing(self, value: _Value, target: Type, path: Path, written: Expression) -> Mapping[Path, Changing]:
        """Return the scalars that hold a changing value, by path."""
        field = _field_at(self._envelope, path)
        if value.is_time and value.factor == 1 and str(target) == _TIMESTAMP:
            parts = message_of(field).fields_by_name
            return {
                (*path, "seconds"): _integer_time(parts["seconds"], Int(64, signed=True), NS_PER_SECOND),
                (*path, "nanos"): _integer_time(parts["nanos"], Int(32, signed=True), 1, NS_PER_SECOND),
            }
        if value.is_time and isinstance(target, Float) and target.bits == 64:
            size, scale = encoding_of(field).size, float(value.factor / NS_PER_SECOND)
            return {path: Changing(size, BesideEncoding.DOUBLE, BesideValue.TIME, scale=scale)}
        if not isinstance(target, Int):
            raise self._mismatch(value, target, written)
        if not value.is_time:
            return {path: self._number(field, target, path)}
        unit = NS_PER_SECOND / value.factor
        if unit.denominator != 1:
            what = f"the unit of '{written.text}' is not a whole number of nanoseconds"
            raise FindingError(written.span, Code.BAD_VALUE, what, f"write `{NOW}`, `{NOW} * 1000` or `{NOW} * 1e6`")
        if _YEAR_2100 * value.factor > target.high:
            what = f"'{written.text}' does not fit {target} until the year 2100"
            hint = "use a 64-bit field, or a coarser unit; `now` is in seconds since 1970"
            raise FindingError(written.span, Code.OUT_OF_RANGE, what, hint)
        return {path: _integer_time(field, target, int(unit))}

    def _mismatch(self, value: _Value, target: Type, written: Expression) -> FindingError:
        if not value.is_time:
            hint = f"'{SEQUENCE}' fills an integer"
        elif isinstance(target, Float):
            hint = "a float32 has too few digits for a time: use a double or an integer"
        else:
            hint = f"'{NOW}' fills a {_TIMESTAMP}; a number needs an integer or a double, `{NOW} * 1000` for ms"
        what = f"cannot assign '{written.text}' to {target}"
        return FindingError(written.span, Code.TYPE_MISMATCH, what, hint)

    def _number(self, field: FieldDescriptor, target: Int, path: Path) -> Changing:
        """Return a number that counts up. It wraps around where the board's firmware can store no more."""
        limits = _limits_at(self.board.fields, self._envelope, path) if self.board else None
        stored = limits.integers if limits is not None and limits.integers is not None else target
        encoding = _encoding(field)
        return Changing(encoding_of(field).size, encoding, BesideValue.NUMBER, stored.bits, stored.signed)

    def _require_fit(self, data: bytes) -> None:
        """Raise FindingError if the board cannot decode a constant."""
        if self.board is None:
            return
        for field, value in scalars(self._around.message_class.FromString(data), self.board.fields):
            if misfit := self.board.misfit(field, value):
                what = f"'{self.endpoint.name}' rejects this: {misfit}"
                raise FindingError(self.fields.span, Code.BOARD_PAYLOAD, what)


@dataclass(frozen=True, slots=True)
class _Value:
    """`sequence`, or `now` in seconds since 1970 times a factor."""

    is_time: bool
    factor: Fraction = Fraction(1)


def _simple(node: Node) -> _Value | None:
    """Return the value of an expression of one of the allowed forms; None for any other."""
    match node:
        case Variable(name=name):
            return _Value(is_time=name == NOW)
        case Binary(operator=Operator.MULTIPLY, left=Variable(name="now"), right=Constant() as factor):
            return _times(factor)
        case Binary(operator=Operator.MULTIPLY, left=Constant() as factor, right=Variable(name="now")):
            return _times(factor)
        case Binary(operator=Operator.DIVIDE, left=Variable(name="now"), right=Constant() as divisor):
            times = _times(divisor)
            return _Value(is_time=True, factor=1 / times.factor) if times else None
    return None


def _times(factor: Constant) -> _Value | None:
    number = factor.value
    if not isinstance(number, (int, float)) or not 0 < number < 1e18:
        return None
    return _Value(is_time=True, factor=Fraction(repr(number)))


def _field_at(message: Descriptor, path: Path) -> FieldDescriptor:
    *way, last = path
    for name in way:
        message = message_of(message.fields_by_name[name])
    return message.fields_by_name[last]


def _limits_at(limits: BoardMessage | None, message: Descriptor, path: Path) -> BoardField | None:
    """Return the limits of a field by path, if it has any."""
    found = None
    for depth in range(len(path)):
        found = limits.get(_field_at(message, path[: depth + 1]).number) if limits else None
        limits = found.message if found else None
    return found


# ---- bytes

_ENCODINGS = {Op.WRITE_VARINT: BesideEncoding.VARINT, Op.WRITE_ZIGZAG: BesideEncoding.ZIGZAG}


def _encoding(field: FieldDescriptor) -> BesideEncoding:
    return _ENCODINGS.get(encoding_of(field).write, BesideEncoding.FIXED)


def _integer_time(field: FieldDescriptor, target: Int, unit: int, modulus: int = 0) -> Changing:
    encoding, size = _encoding(field), encoding_of(field).size
    if encoding is not BesideEncoding.FIXED:
        largest = min(target.high, (1 << 63) // unit)
        size = len(varint(2 * largest if encoding is BesideEncoding.ZIGZAG else largest))
    return Changing(size, encoding, BesideValue.TIME, unit=unit, modulus=modulus)


def _written(
    plan: Record, message: Descriptor, path: Path, changing: Mapping[Path, Changing]
) -> tuple[bytes, list[Changing]]:
    """Write the fields of a message. Return its bytes, and what is filled in them. Raises FindingError."""
    data, places = b"", list[Changing]()
    for member, inner in sorted(plan.members, key=lambda each: each[0].number):
        here, field = (*path, member.name), message.fields_by_name[member.name]
        begin, content, below, end = _parts(plan, field, inner, here, changing)
        places += [replace(each, offset=len(data) + len(begin) + each.offset) for each in below]
        data += begin + content + end
    return data, places


def _parts(
    plan: Record, field: FieldDescriptor, inner: Plan, here: Path, changing: Mapping[Path, Changing]
) -> tuple[bytes, bytes, list[Changing], bytes]:
    """Return what begins a field, its content, what is filled in that, and what ends the field."""
    if here in changing:
        return varint(field.number << 3 | encoding_of(field).wire_type), changing[here].zero, [changing[here]], b""
    if not isinstance(inner, Record) or not any(path[: len(here)] == here for path in changing):
        member = next(each for each in plan.members if each[0].name == field.name)
        return b"", fields_of(Record(plan.type, (member,), plan.span), container(field)), [], b""
    content, below = _written(inner, message_of(field), here, changing)
    if field.type == FieldDescriptor.TYPE_GROUP:
        return varint(field.number << 3 | GROUP), content, below, varint(field.number << 3 | GROUP_END)
    return varint(field.number << 3 | LEN) + varint(len(content)), content, below, b""


def unfilled(fields: MessageType, beside: Beside | None) -> list[Field]:
    """Return the fields beside the payload that nothing fills. Of a oneof, one is enough."""
    filled = [member for member, plan in beside.plan.members if not isinstance(plan, Unset)] if beside else []
    oneofs = {member.oneof for member in filled if member.oneof}
    return [member for member in fields.fields if member not in filled and member.oneof not in oneofs]

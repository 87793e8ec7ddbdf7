"""Converts a checked value to the plan of the field that it fills.

Messages are converted field by field, lists element by element, scalars by a node that converts or checks them. No
conversion is lossy unless the table requests it. Known ranges are checked here, rounded floats at run time: a value
that does not fit drops the message for that target. An enum saturates in a narrower integer, as in the boards'
firmware. Every function raises ExpressionError if the value does not fit.
"""

from __future__ import annotations

import math

from router.compiler.expressions import ExpressionError, Scope, tree
from router.compiler.expressions.functions import FLOAT32_END, NS_PER_SECOND
from router.compiler.expressions.kinds import (
    DURATION_TYPES,
    INT32,
    INT64,
    OCTET,
    PROTOBUF_DURATION,
    STAMP_TYPES,
    BoolKind,
    BytesKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    MessageKind,
    StringKind,
    TimeKind,
    element_of,
    fields_hint,
    length_of,
)
from router.compiler.expressions.lists import fitted, limited
from router.compiler.expressions.scope import field_of, require_readable
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.errors import Code, SourceSpan, did_you_mean, plural
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type

_SECONDS = IntKind(INT64.low // NS_PER_SECOND, INT64.high // NS_PER_SECOND)

_EXACT_INTEGER_BITS = {32: 24, 64: 53}
"""Integers of up to this many bits are exact in a float of that width."""


def convert(value: tree.Node, target: Type, scope: Scope) -> Plan:
    """Return the plan of a field of type `target` that `value` fills. Raises ExpressionError if it does not fit."""
    require_readable(value)
    if isinstance(target, MessageType):
        return _to_message(value, target, scope)
    if isinstance(target, List):
        return _to_list(value, target, scope)
    if isinstance(value.kind, MessageKind) and len(value.kind.type.fields) == 1:
        (only,) = value.kind.type.fields
        return convert(field_of(value, only, value.span), target, scope)
    return Leaf(target, converted(value, target), value.span)


def same_named(holder: tree.Node, member: Field) -> tree.Node | None:
    """Return the field of `holder` with the name of `member`, or None."""
    field = holder.kind.type.field(member.name) if isinstance(holder.kind, MessageKind) else None
    return field_of(holder, field, holder.span) if field else None


def unset(member: Field, span: SourceSpan) -> Unset:
    """Return the plan of a field that nothing fills."""
    return Unset(member.type, member.default, span)


# messages


def _to_message(value: tree.Node, target: MessageType, scope: Scope) -> Plan:
    if isinstance(value.kind, TimeKind) and target.name in STAMP_TYPES | DURATION_TYPES:
        return _to_time(value, target)
    if isinstance(value.kind, MessageKind):
        if {value.kind.type.name, target.name} in (STAMP_TYPES, DURATION_TYPES):
            return _to_time(_nanoseconds(value, value.kind.type), target)
        return _to_same_named(value, value.kind.type, target, scope)
    if len(target.fields) == 1:
        (only,) = target.fields
        return Record(target, ((only, convert(value, only.type, scope)),), value.span)
    if isinstance(value.kind, (IntKind, FloatKind)) and target.name in STAMP_TYPES | DURATION_TYPES:
        raise mismatch(value, target, "convert it with time_from_seconds(x) or time_from_milliseconds(x)")
    raise mismatch(value, target, "map its fields one by one")


def _nanoseconds(value: tree.Node, moment: MessageType) -> tree.Node:
    """Return a Timestamp or Duration of protobuf in nanoseconds. What ROS cannot hold is rejected at run time."""
    seconds, nanos = (field_of(value, member, value.span) for member in moment.fields)
    least = 0 if moment.name in STAMP_TYPES else 1 - NS_PER_SECOND
    whole = _with_number(INT64, fitted(seconds, INT32), tree.Operator.MULTIPLY, NS_PER_SECOND)
    return tree.Binary(INT64, value.span, tree.Operator.ADD, whole, fitted(nanos, IntKind(least, NS_PER_SECOND - 1)))


def _to_time(value: tree.Node, target: MessageType) -> Record:
    """Fill seconds and nanoseconds from nanoseconds. Seconds that do not fit are rejected at run time."""
    parts = _signed_parts(value) if target.name == PROTOBUF_DURATION else _parts(value)
    members = zip(target.fields, parts, strict=True)
    return Record(target, tuple((member, _part(member.type, part)) for member, part in members), value.span)


def _parts(value: tree.Node) -> tuple[tree.Binary, tree.Binary]:
    """Return whole seconds, rounded down, and nanoseconds."""
    return (
        _with_number(_SECONDS, value, tree.Operator.FLOOR_DIVIDE, NS_PER_SECOND),
        _with_number(IntKind(0, NS_PER_SECOND - 1), value, tree.Operator.MODULO, NS_PER_SECOND),
    )


def _signed_parts(value: tree.Node) -> tuple[tree.Binary, tree.Binary]:
    """Return whole seconds, rounded towards zero, and nanoseconds of the same sign."""
    span = value.span
    is_negative = tree.Compare(BoolKind(), span, (tree.Relation.LESS,), (value, tree.whole(0, span)))
    raised = _with_number(INT64, value, tree.Operator.ADD, NS_PER_SECOND - 1)
    seconds, _ = _parts(tree.Choice(INT64, span, is_negative, raised, value))
    whole = _with_number(INT64, seconds, tree.Operator.MULTIPLY, NS_PER_SECOND)
    rest = IntKind(1 - NS_PER_SECOND, NS_PER_SECOND - 1)
    return seconds, tree.Binary(rest, span, tree.Operator.SUBTRACT, value, whole)


def _with_number(kind: IntKind, left: tree.Node, operator: tree.Operator, right: int) -> tree.Binary:
    return tree.Binary(kind, left.span, operator, left, tree.whole(right, left.span))


def _part(declared: Type, value: tree.Binary) -> Leaf:
    assert isinstance(declared, Int)  # noqa: S101 - times are made of integers
    assert isinstance(value.kind, IntKind)  # noqa: S101
    limits = _range(declared)
    return Leaf(declared, value if limits.holds(value.kind) else fitted(value, limits), value.span)


def _to_same_named(value: tree.Node, source: MessageType, target: MessageType, scope: Scope) -> Record:
    members: list[tuple[Field, Plan]] = []
    for member in target.fields:
        given = same_named(value, member)
        members.append((member, _to_member(given, member, scope) if given else unset(member, value.span)))
    if target.fields and not any(source.field(member.name) for member in target.fields):
        names = {source.name, target.name}
        is_time = names & STAMP_TYPES and names & DURATION_TYPES
        hint = "one is a point in time, the other a duration" if is_time else "they have no field name in common"
        raise mismatch(value, target, hint)
    return Record(target, tuple(members), value.span)


def _to_member(given: tree.Node, member: Field, scope: Scope) -> Plan:
    """Fill a field from one of the same name. Errors name the field."""
    try:
        return convert(given, member.type, scope)
    except ExpressionError as error:
        finding = error.diagnostic
        raise ExpressionError(finding.span, finding.code, f"{member.name}: {finding.message}", finding.hint) from error


# lists


def _to_list(value: tree.Node, target: List, scope: Scope) -> Plan:
    if isinstance(value, tree.ListLiteral):
        require_length(value.span, target, len(value.items))
        return Items(target, tuple(convert(item, target.element, scope) for item in value.items), value.span)
    lists, element = elements_of(value, target, scope)
    fill = convert if isinstance(value, tree.Each) else _to_element
    return Each(target, lists, fill(element, target.element, scope), value.span)


def elements_of(value: tree.Node, target: List, scope: Scope) -> tuple[tuple[tuple[str, tree.Node], ...], tree.Node]:
    """Return the lists of `plan.Each` for a list `value`, and one element of it.

    Raises ExpressionError if it is not a list, or never as long as the target.
    """
    element_kind, length = element_of(value.kind), length_of(value.kind)
    if element_kind is None:
        raise mismatch(value, target, how_to_fill(target, scope))
    if length is not None:
        require_length(value.span, target, length)
    if isinstance(value, tree.Each):
        return value.lists, value.element
    element = tree.Variable(element_kind, value.span, scope.element_variable())
    return ((element.name, value),), element


_BY_FIELDS = "write its elements, [{FIELD: VALUE}]"
_LIKE_MESSAGES = (
    "fill it from a list of messages, of which fields of the same name are copied; map their fields, "
    f"{{each: LIST, fields: {{FIELD: VALUE}}}}; or {_BY_FIELDS}"
)


def how_to_fill(target: List, scope: Scope) -> str:
    """Return the hint for a list that something else than a list would fill."""
    if not isinstance(target.element, MessageType):
        return "write a list, [a, b]"
    return _LIKE_MESSAGES if tree.MESSAGE in scope.given else _BY_FIELDS


def _to_element(element: tree.Node, target: Type, scope: Scope) -> Plan:
    """Fill an element from one of another list. The hint of an error says how to fill its fields."""
    try:
        return convert(element, target, scope)
    except ExpressionError as error:
        finding = error.diagnostic
        if not isinstance(element.kind, MessageKind):
            hint = _LIKE_MESSAGES if isinstance(target, MessageType) else finding.hint
        elif isinstance(target, MessageType):
            both = f"{element.kind} and {target}"
            hint = f"map the fields, {{each: LIST, fields: ...}}, or give {both} fields of the same name and type"
        else:
            hint = "name a field of the elements, as in x.y"
        raise ExpressionError(finding.span, finding.code, f"list element: {finding.message}", hint) from error


def require_length(span: SourceSpan, target: List, length: int) -> None:
    """Raise ExpressionError if a list of this length does not fit the field."""
    if target.length is not None and length != target.length:
        message = f"{target} takes {target.length} elements, not {length}"
        change = "add" if length < target.length else "remove"
        hint = f"{change} {plural(abs(target.length - length), 'element')}"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message, hint)
    if target.bound is not None and length > target.bound:
        message = f"{target} takes at most {target.bound} elements, not {length}"
        hint = f"remove {plural(length - target.bound, 'element')}"
        raise ExpressionError(span, Code.OUT_OF_RANGE, message, hint)


# scalars


def converted(value: tree.Node, target: Type) -> tree.Node:
    """Return the expression that fills a scalar field. Raises ExpressionError if it does not fit."""
    _require_finite(value, target)
    match target:
        case Bool():
            return _to_bool(value, target)
        case Int():
            return _to_int(value, target)
        case Float():
            return _to_float(value, target)
        case String():
            return _to_string(value, target)
        case Enum():
            return _to_enum(value, target)
        case Bytes():
            return _to_bytes(value, target)
        case List() | MessageType():
            raise AssertionError(f"{target} is not a scalar")


def _require_finite(value: tree.Node, target: Type) -> None:
    """Raise ExpressionError if `nan` or `inf` would fill a field that is not a float."""
    literal = tree.constant_of(value)
    if isinstance(literal, float) and not isinstance(target, Float) and not math.isfinite(literal):
        hint = f"for text, write {{text: {literal}}}" if isinstance(target, String) else ""
        message = f"cannot assign {literal} to {target}"
        raise ExpressionError(
            value.span, Code.TYPE_MISMATCH, message, hint or f"write a finite value: only a float field holds {literal}"
        )


_OF_LIST = ", or min(x), max(x), sum(x) or len(x)"


def mismatch(value: tree.Node, target: Type, hint: str = "") -> ExpressionError:
    """Return the error for a value whose kind cannot fill the type."""
    if isinstance(value.kind, ListKind) and not isinstance(target, (List, MessageType)):
        element = value.kind.element
        if isinstance(element, MessageKind) and (field := next(iter(element.type.fields), None)):
            hint = hint or f"write a field of one element, such as x[0].{field.name}"
        hint = hint or "write x[0] for one element" + _OF_LIST * isinstance(target, (Int, Float))
    if not isinstance(target, (List, MessageType)):
        hint = hint or fields_hint(value.kind)
    return ExpressionError(value.span, Code.TYPE_MISMATCH, f"cannot assign {value.kind} to {target}", hint)


def _to_bool(value: tree.Node, target: Bool) -> tree.Node:
    if isinstance(value.kind, BoolKind):
        return value
    if (literal := tree.constant_of(value)) in (0, 1):
        raise mismatch(value, target, f"write {'true' if literal else 'false'}")
    raise mismatch(value, target, "compare it, as in x != 0" if isinstance(value.kind, (IntKind, FloatKind)) else "")


def _to_int(value: tree.Node, target: Int) -> tree.Node:
    match value.kind:
        case EnumKind():
            return _saturate(value, _range(target))
        case IntKind() as kind:
            return _fit(value, kind, _range(target))
        case FloatKind():
            hint = "convert it with round() or trunc()"
            raise ExpressionError(value.span, Code.LOSSY_CONVERSION, f"a float does not fit {target}", hint)
        case BoolKind():
            raise mismatch(value, target, "convert a bool with int()")
        case TimeKind():
            raise mismatch(value, target, "convert a time with round(seconds(...))")
        case _:
            raise mismatch(value, target)


def _saturate(value: tree.Node, limits: IntKind) -> tree.Node:
    """Limit an enum to an integer's range."""
    if limits.holds(INT32):
        return value
    kind = IntKind(max(INT32.low, limits.low), min(INT32.high, limits.high))
    literal = tree.constant_of(value)
    if isinstance(literal, int):
        return tree.Constant(kind, value.span, max(kind.low, min(literal, kind.high)))
    return limited("clamp", value, kind, limits.low, limits.high)


def _range(target: Int) -> IntKind:
    return IntKind(target.low, target.high)


def _fit(value: tree.Node, kind: IntKind, limits: IntKind) -> tree.Node:
    if limits.holds(kind):
        return value
    what = f"{value.kind} does not fit {limits}"
    if kind.high < limits.low or kind.low > limits.high:
        raise ExpressionError(value.span, Code.OUT_OF_RANGE, what, f"write a value from {limits.low} to {limits.high}")
    if kind.is_rounded:
        return fitted(value, limits)
    raise ExpressionError(value.span, Code.LOSSY_CONVERSION, what, "limit it with clamp() or wrap()")


def _to_float(value: tree.Node, target: Float) -> tree.Node:
    limit = 1 << _EXACT_INTEGER_BITS[target.bits]
    match value.kind:
        case FloatKind(bits):
            literal = tree.constant_of(value)
            if target.bits == 32 and isinstance(literal, float) and FLOAT32_END <= abs(literal) < math.inf:
                raise ExpressionError(value.span, Code.OUT_OF_RANGE, f"{literal!r} does not fit float32")
            if bits > target.bits:
                hint = "to accept the loss of digits, use float32()"
                raise ExpressionError(value.span, Code.LOSSY_CONVERSION, f"a double does not fit {target}", hint)
            return value
        case IntKind() as kind:
            if kind.is_rounded or IntKind(-limit, limit).holds(kind):
                return value
            hint = f"to accept the loss of digits, use float{target.bits}()"
            raise ExpressionError(value.span, Code.LOSSY_CONVERSION, f"{value.kind} does not fit {target}", hint)
        case EnumKind() | BoolKind():
            raise mismatch(value, target, "convert it with int()")
        case TimeKind():
            raise mismatch(value, target, "convert a time with seconds()")
        case _:
            raise mismatch(value, target)


def _to_string(value: tree.Node, target: String) -> tree.Node:
    if not isinstance(value.kind, StringKind):
        is_float = isinstance(value.kind, FloatKind)
        hint = "convert it with str()" if isinstance(value.kind, (IntKind, EnumKind, BoolKind)) else ""
        raise mismatch(value, target, "convert it with text(x, 2)" if is_float else hint)
    if target.wide:
        hint = "omit it to keep its default, or declare it as a string"
        raise ExpressionError(value.span, Code.FORBIDDEN_EXPRESSION, "expressions cannot fill a wstring", hint)
    literal = tree.constant_of(value)
    if isinstance(literal, str):
        _require_text(value, literal, target)
        return value
    if target.bound is None:
        return value
    return limited("fit_text", value, StringKind(), target.bound)


def _require_text(value: tree.Node, text: str, target: String) -> None:
    """Raise ExpressionError if a text literal does not fit the field."""
    try:
        length = len(text.encode())
    except UnicodeEncodeError as error:
        raise ExpressionError(
            value.span, Code.OUT_OF_RANGE, f"{error.object[error.start]!a} is not a character"
        ) from None
    if "\0" in text:
        raise ExpressionError(value.span, Code.OUT_OF_RANGE, "a string cannot hold a NUL")
    if target.bound is not None and length > target.bound:
        raise ExpressionError(value.span, Code.OUT_OF_RANGE, f"{length} bytes do not fit {target}")


def _to_enum(value: tree.Node, target: Enum) -> tree.Node:
    match value.kind:
        case EnumKind(enum) if enum == target:
            return value
        case IntKind() as kind:
            return _member(_fit(value, kind, INT32), target)
        case StringKind() if isinstance(literal := tree.constant_of(value), str):
            return tree.Constant(EnumKind(target), value.span, _number_of(value, literal, target))
        case StringKind():
            return tree.Call(EnumKind(target), value.span, "named", (value,))
        case _:
            raise mismatch(value, target, f"name one of its values: {target.name}.{target.values[0][0]}")


def _member(value: tree.Node, target: Enum) -> tree.Node:
    """Return a number as a value of the enum; a closed enum rejects unknown values at run time."""
    literal = tree.constant_of(value)
    if not target.is_closed:
        return value
    if literal is None:
        return tree.Call(EnumKind(target), value.span, "member", (value,))
    if literal not in dict(target.values).values():
        hint = f"the enum is closed: name one of its values, such as {target.name}.{target.values[0][0]}"
        raise ExpressionError(value.span, Code.UNKNOWN_ENUM_VALUE, f"'{target}' has no value {literal}", hint)
    return value


def _number_of(value: tree.Node, name: str, target: Enum) -> int:
    numbers = dict(target.values)
    if name not in numbers:
        hint = did_you_mean(name, numbers)
        raise ExpressionError(value.span, Code.UNKNOWN_ENUM_VALUE, f"'{target}' has no value '{name}'", hint)
    return numbers[name]


def _to_bytes(value: tree.Node, target: Bytes) -> tree.Node:
    octets = value
    match value.kind:
        case BytesKind():
            pass
        case ListKind(element, length) if element is None or _is_octet(element):
            if target.bound is not None and length is not None and length > target.bound:
                raise ExpressionError(value.span, Code.OUT_OF_RANGE, f"{length} bytes do not fit {target}")
            octets = tree.Call(BytesKind(), value.span, "octets", (value,))
        case ListKind():
            raise mismatch(value, target, f"bytes are integers {OCTET.low}..{OCTET.high}")
        case _:
            raise mismatch(value, target)
    return octets if target.bound is None else limited("fit_text", octets, BytesKind(), target.bound)


def _is_octet(kind: Kind) -> bool:
    """Return whether an element of this kind can be a byte; an integer of unknown range is checked at run time."""
    if not isinstance(kind, IntKind):
        return False
    return kind.is_rounded or OCTET.holds(kind)

"""Literals and operators: the operands that they take, the kind of the result, and the range of an integer result.

The operands themselves are already checked.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from router.compiler.expressions.kinds import (
    INT64,
    UINT64,
    BoolKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    MessageKind,
    Number,
    StringKind,
    TimeKind,
    as_int,
    element_of,
    fields_hint,
    float_bits,
    is_list,
    join,
    within_64_bits,
)
from router.compiler.expressions.lists import as_kind, as_value
from router.compiler.expressions.scope import ExpressionError, Scope
from router.compiler.expressions.syntax import forbidden
from router.compiler.expressions.tree import (
    Binary,
    Call,
    Choice,
    Compare,
    Constant,
    Contains,
    Logic,
    Node,
    Operator,
    Read,
    Relation,
    Unary,
    constant_of,
)
from router.errors import Code, SourceSpan


def constant(value: object, span: SourceSpan) -> Constant:
    """Return a literal. Raises ExpressionError if the language does not have it, or if it is too large."""
    match value:
        case bool():
            return Constant(BoolKind(), span, value)
        case int():
            return Constant(integer([value], span)[0], span, value)
        case float():
            if not math.isfinite(value):
                raise ExpressionError(span, Code.OUT_OF_RANGE, "this literal is too large for a float64")
            return Constant(FloatKind(32), span, value)
        case str():
            return Constant(StringKind(), span, value)
        case _:
            raise forbidden(ast.Constant(None), span)


def integer(extremes: Iterable[int], span: SourceSpan, is_rounded: bool = False) -> tuple[IntKind, bool]:
    """Return the kind of an integer between `extremes`, and whether a result must be checked at run time.

    Raises ExpressionError if the integer never fits 64 bits.
    """
    values = [*extremes]
    kind, is_checked = within_64_bits(values, is_rounded)
    if kind is None or (is_checked and min(values) == max(values)):
        message = "this integer never fits 64 bits"
        raise ExpressionError(span, Code.OUT_OF_RANGE, message, f"write an integer from {INT64.low} to {UINT64.high}")
    return kind, is_checked


LARGEST_EXPONENT = 8

_OPERATORS: Mapping[type[ast.operator], Operator] = {
    ast.Add: Operator.ADD,
    ast.Sub: Operator.SUBTRACT,
    ast.Mult: Operator.MULTIPLY,
    ast.Div: Operator.DIVIDE,
    ast.FloorDiv: Operator.FLOOR_DIVIDE,
    ast.Mod: Operator.MODULO,
    ast.Pow: Operator.POWER,
}
_RELATIONS: Mapping[type[ast.cmpop], Relation] = {
    ast.Eq: Relation.EQUAL,
    ast.NotEq: Relation.UNEQUAL,
    ast.Lt: Relation.LESS,
    ast.LtE: Relation.LESS_OR_EQUAL,
    ast.Gt: Relation.GREATER,
    ast.GtE: Relation.GREATER_OR_EQUAL,
}
_COMPUTED: Mapping[Operator, Callable[[Any, Any], Any]] = {
    Operator.ADD: operator.add,
    Operator.SUBTRACT: operator.sub,
    Operator.MULTIPLY: operator.mul,
    Operator.DIVIDE: lambda x, y: float(x) / float(y),
    Operator.FLOOR_DIVIDE: operator.floordiv,
    Operator.MODULO: operator.mod,
    Operator.POWER: operator.pow,
}
_MONOTONE = (Operator.ADD, Operator.SUBTRACT, Operator.MULTIPLY)
"""Operators whose result is extreme at the extremes of the operands."""

_DIVISIONS = (Operator.DIVIDE, Operator.FLOOR_DIVIDE, Operator.MODULO)


# arithmetic


def unary(op: ast.unaryop, operand: Node, span: SourceSpan) -> Node:
    if isinstance(op, ast.Not):
        require_bool(operand, "not")
        return Unary(BoolKind(), span, Operator.NOT, operand)
    if not isinstance(op, (ast.USub, ast.UAdd)):
        raise forbidden(op, span)
    _require_number(operand)
    value, number = constant_of(operand), as_int(operand.kind)
    if isinstance(op, ast.UAdd):
        if number is None or number == operand.kind:
            return operand
        return Call(number, span, "int", (operand,)) if value is None else Constant(number, span, value)
    kind: Kind = FloatKind(float_bits(operand.kind))
    is_checked = False
    if number is not None:
        kind, is_checked = integer((-number.low, -number.high), span, number.is_rounded)
    if isinstance(value, (int, float)):
        return Constant(kind, span, -value)
    return Unary(kind, span, Operator.NEGATE, operand, is_checked)


def require_binary(op: ast.operator, span: SourceSpan) -> Operator:
    """Return an operator. Raises ExpressionError if the language does not have it."""
    if type(op) not in _OPERATORS:
        raise forbidden(op, span)
    return _OPERATORS[type(op)]


def binary(op: Operator, left: Node, right: Node, span: SourceSpan) -> Node:
    if op is Operator.ADD and isinstance(left.kind, StringKind) and isinstance(right.kind, StringKind):
        return folded(Binary(StringKind(), span, op, left, right))
    if isinstance(left.kind, TimeKind) or isinstance(right.kind, TimeKind):
        raise ExpressionError(
            span,
            Code.TYPE_MISMATCH,
            "arithmetic does not take times",
            "convert with seconds(x) and time_from_seconds(x)",
        )
    _require_number(left)
    _require_number(right)
    if op in _DIVISIONS and constant_of(right) == 0:
        raise _division_by_zero(span)
    a, b = as_int(left.kind), _exponent(right) if op is Operator.POWER else as_int(right.kind)
    if a is None or b is None or op is Operator.DIVIDE:
        if op is Operator.POWER:
            return folded(Binary(FloatKind(float_bits(left.kind)), span, op, left, right))
        kind = FloatKind(max(float_bits(left.kind), float_bits(right.kind)))
        return folded(Binary(kind, span, op, _literal_as_float(left), _literal_as_float(right)))
    if (b.low, b.high) == (0, 0) and op in _DIVISIONS:
        raise _division_by_zero(span)
    whole, is_checked = integer(_extremes(op, a, b), span, a.is_rounded or b.is_rounded)
    return folded(Binary(whole, span, op, left, right, is_checked))


def _literal_as_float(operand: Node) -> Node:
    literal = constant_of(operand)
    return Constant(FloatKind(32), operand.span, float(literal)) if isinstance(literal, int) else operand


def folded(operation: Binary) -> Binary | Constant:
    """Evaluate arithmetic of two literals, so that the result is checked against the target."""
    left, right = constant_of(operation.left), constant_of(operation.right)
    if left is None or right is None:
        return operation
    try:
        value = _COMPUTED[operation.operator](left, right)
    except ArithmeticError as error:
        raise ExpressionError(operation.span, Code.OUT_OF_RANGE, str(error)) from None
    if isinstance(value, float) and not math.isfinite(value):
        raise ExpressionError(
            operation.span, Code.OUT_OF_RANGE, f"this is always {value}", f"write {value} if that is intended"
        )
    return constant(value, operation.span)


def _extremes(op: Operator, left: IntKind, right: IntKind) -> list[int]:
    """Return integers that include the smallest and the largest value of `left op right`."""
    bounds, (low, high) = (left.low, left.high), (right.low, right.high)
    if op in _MONOTONE:
        return [_COMPUTED[op](x, y) for x in bounds for y in (low, high)]
    if op is Operator.POWER:
        return [left.low**high, left.high**high, *[0] * (left.low < 0 < left.high)]
    if op is Operator.MODULO:  # has the divisor's sign
        return [min(low + 1, 0), max(high - 1, 0)]
    divisors = [y for y in (low, high, -1, 1) if low <= y <= high and y != 0]
    return [x // y for x in bounds for y in divisors]


def _exponent(node: Node) -> IntKind:
    """Return the range of an exponent, which must be a literal."""
    value = constant_of(node)
    if not isinstance(value, int) or not 0 <= value <= LARGEST_EXPONENT:
        message = f"an exponent must be a literal integer from 0 to {LARGEST_EXPONENT}"
        hint = "write sqrt(x) for a root, 1 / x ** 2 for a negative exponent"
        raise ExpressionError(node.span, Code.FORBIDDEN_EXPRESSION, message, hint)
    return IntKind(value, value)


def _division_by_zero(span: SourceSpan) -> ExpressionError:
    return ExpressionError(span, Code.OUT_OF_RANGE, "division by zero")


def _require_number(operand: Node) -> None:
    if not isinstance(operand.kind, Number):
        hint = {BoolKind: "convert a bool with int()", StringKind: "convert a number to text with str(x) or text(x, 2)"}
        raise ExpressionError(operand.span, Code.TYPE_MISMATCH, f"arithmetic takes numbers, not {operand.kind}",
                      hint.get(type(operand.kind), "") or fields_hint(operand.kind))  # fmt: skip


# truth

_OF_LISTS = "compare an element, len(x), min(x) or max(x), or write `value in x`"


def boolean(op: ast.boolop, operands: Sequence[Node], span: SourceSpan) -> Logic:
    is_all = isinstance(op, ast.And)
    for operand in operands:
        require_bool(operand, "and" if is_all else "or")
    return Logic(BoolKind(), span, is_all, tuple(operands))


def comparison(ops: Sequence[ast.cmpop], operands: Sequence[Node], span: SourceSpan, scope: Scope) -> Node:
    """Return a comparison: `a < b < c` has two operators and three operands."""
    for op, (left, right) in zip(ops, pairwise(operands), strict=True):
        _require_comparable(op, left, right, span)
    if not any(isinstance(op, (ast.In, ast.NotIn)) for op in ops):
        return Compare(BoolKind(), span, tuple(_RELATIONS[type(op)] for op in ops), tuple(operands))
    tests = [_test(op, left, right, span, scope) for op, (left, right) in zip(ops, pairwise(operands), strict=True)]
    return tests[0] if len(tests) == 1 else Logic(BoolKind(), span, True, tuple(tests))


def _test(op: ast.cmpop, left: Node, right: Node, span: SourceSpan, scope: Scope) -> Compare | Contains:
    if isinstance(op, (ast.In, ast.NotIn)):
        return Contains(BoolKind(), span, left, as_value(right, scope), isinstance(op, ast.NotIn))
    return Compare(BoolKind(), span, (_RELATIONS[type(op)],), (left, right))


def equality(left: Node, right: Node, span: SourceSpan) -> Node:
    """Return `left == right`."""
    _require_comparable(ast.Eq(), left, right, span)
    return Compare(BoolKind(), span, (Relation.EQUAL,), (left, right))


def _comparison_hint(left: Node, right: Node) -> str:
    kinds = (left.kind, right.kind)
    if any(isinstance(kind, MessageKind) for kind in kinds):
        return "compare its fields"
    if any(isinstance(kind, TimeKind) for kind in kinds):
        return "compare seconds(x), or convert the other side with time_from_seconds(x)"
    if any(map(is_list, kinds)):
        return _OF_LISTS
    return _comparable_value(left, right) or _comparable_value(right, left)


def _comparable_value(held: Node, written: Node) -> str:
    """Return a hint if an enum is compared with the quoted name of one of its values, else an empty string."""
    value = constant_of(written)
    if not isinstance(held.kind, EnumKind) or value is None:
        return ""
    enum = held.kind.enum
    return f"did you mean {enum}.{value} without quotes?" if value in dict(enum.values) else ""


def _require_comparable(op: ast.cmpop, left: Node, right: Node, span: SourceSpan) -> None:
    if isinstance(op, (ast.Is, ast.IsNot)):
        raise forbidden(op, span)
    if any(value != value for value in map(constant_of, (left, right))):  # noqa: PLR0124 - NaN
        raise ExpressionError(
            span, Code.TYPE_MISMATCH, "nan equals nothing, not even nan", "to test for NaN, write x != x"
        )
    other: Kind | None = right.kind
    if isinstance(op, (ast.In, ast.NotIn)):
        if not is_list(right.kind):
            hint = "compare whole texts with ==" if isinstance(right.kind, StringKind) else ""
            raise ExpressionError(right.span, Code.TYPE_MISMATCH, f"'in' takes a list, not {right.kind}", hint)
        other = element_of(right.kind)
    if other is None or isinstance(left.kind, MessageKind) or is_list(left.kind) or join(left.kind, other) is None:
        message = f"{left.kind} cannot be compared with {right.kind}"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message, _comparison_hint(left, right))
    if isinstance(op, (ast.Lt, ast.LtE, ast.Gt, ast.GtE)) and isinstance(left.kind, BoolKind):
        raise ExpressionError(span, Code.TYPE_MISMATCH, "bools have no order", "use == or !=")


def choice(test: Node, body: Node, orelse: Node, span: SourceSpan, scope: Scope) -> Choice:
    """Return `body if test else orelse`, where `test` is a bool."""
    kind = join(body.kind, orelse.kind)
    if kind is None:
        message = f"no field can hold both {body.kind} and {orelse.kind}"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message)
    if isinstance(kind, MessageKind):
        message, hint = f"a choice cannot yield a whole {kind}", "choose for each field, as in a.x if c else b.x"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message, hint)
    if isinstance(element_of(kind), MessageKind):
        message, hint = f"a choice cannot yield a {kind}", "use one of the two: only lists of scalars can be chosen"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message, hint)
    return Choice(kind, span, test, as_kind(body, kind, scope), as_kind(orelse, kind, scope))


def presence_hint(operand: Node) -> str:
    """Return a hint for a message used as a bool; empty if it is always present, and for anything else."""
    if not isinstance(operand, Read) or not isinstance(operand.kind, MessageKind) or not operand.field.has_presence:
        return ""
    names, holder = [operand.field.name], operand.holder
    while isinstance(holder, Read):
        names.insert(0, holder.field.name)
        holder = holder.holder
    return f"write `has({'.'.join(names)})`"


def require_bool(operand: Node, word: str) -> None:
    if not isinstance(operand.kind, BoolKind):
        hint = _OF_LISTS if is_list(operand.kind) else ""
        hint = "compare it, as in x != 0" if isinstance(operand.kind, Number) else hint or presence_hint(operand)
        raise ExpressionError(operand.span, Code.TYPE_MISMATCH, f"'{word}' takes a bool, not {operand.kind}", hint)

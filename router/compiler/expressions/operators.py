"""Literals, lists and operators: what they take, the kind of the result, and the bounds of an integer result.

Operands are checked before.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeVar

from router.compiler.expressions.kinds import (
    ANY_INT,
    BoolKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    MessageKind,
    Number,
    StringKind,
    TimeKind,
    as_int,
    float_bits,
    join,
)
from router.compiler.expressions.scope import ExpressionError
from router.compiler.expressions.syntax import forbidden
from router.compiler.expressions.tree import (
    Binary,
    Call,
    Choice,
    Compare,
    Constant,
    Contains,
    Element,
    Listed,
    Logic,
    Node,
    Operator,
    Relation,
    Unary,
    constant_of,
)
from router.errors import Code, SourceSpan

WIDEST = 512
"""Bits of the widest integer in an expression."""


def constant(value: object, span: SourceSpan) -> Constant:
    """A literal. Raises ExpressionError for one that the language does not have, or that is infinite."""
    match value:
        case bool():
            return Constant(BoolKind(), span, value)
        case int():
            return Constant(within_bounds(IntKind(value, value), span), span, value)
        case float():
            if not math.isfinite(value):
                raise ExpressionError(span, Code.OUT_OF_RANGE, "a literal this large is infinite")
            return Constant(FloatKind(32), span, value)
        case str():
            return Constant(StringKind(), span, value)
        case _:
            raise forbidden(ast.Constant(None), span)


Bounded = TypeVar("Bounded", bound=Kind)


def within_bounds(kind: Bounded, span: SourceSpan) -> Bounded:
    """Refuse integers of more than WIDEST bits, so that powers of powers do not take all memory."""
    if isinstance(kind, IntKind) and kind.bounds and max(bound.bit_length() for bound in kind.bounds) > WIDEST:
        raise ExpressionError(span, Code.OUT_OF_RANGE, f"an integer has at most {WIDEST} bits")
    return kind


def list_of(items: Sequence[Node], span: SourceSpan) -> Listed:
    """A list literal, whose elements have one kind in common."""
    element: Kind | None = items[0].kind if items else None
    for item in items[1:]:
        element = join(element, item.kind) if element else None
        if element is None:
            raise ExpressionError(item.span, Code.TYPE_MISMATCH, f"a list of {items[0].kind} cannot hold {item.kind}")
    return Listed(ListKind(element, len(items)), span, tuple(items))


def element_of(holder: Node, index: Node, span: SourceSpan) -> Element:
    """`holder[index]`."""
    kind, position = holder.kind, constant_of(index)
    if not isinstance(kind, ListKind) or kind.element is None:
        raise ExpressionError(span, Code.TYPE_MISMATCH, f"a {kind} has no elements", "only lists are indexed")
    if not isinstance(position, int) or isinstance(position, bool) or position < 0:
        raise ExpressionError(index.span, Code.FORBIDDEN_EXPRESSION, "an index is a literal integer from 0")
    if kind.length is not None and position >= kind.length:
        raise ExpressionError(index.span, Code.OUT_OF_RANGE, f"index {position} of {kind.length} elements")
    return Element(kind.element, span, holder, position)


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
    ast.Gt: Relation.MORE,
    ast.GtE: Relation.MORE_OR_EQUAL,
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


def as_float(operand: Node, kind: Kind) -> Node:
    """An operand of what gives a value of `kind`: where that is a float, an integer becomes one."""
    if not isinstance(kind, FloatKind) or as_int(operand.kind) is None:
        return operand
    literal = constant_of(operand)
    if literal is None:
        return Call(kind, operand.span, "float64", (operand,))
    return Constant(kind, operand.span, float(literal))


def unary(op: ast.unaryop, operand: Node, span: SourceSpan) -> Node:
    if isinstance(op, ast.Not):
        want_bool(operand, "not")
        return Unary(BoolKind(), span, Operator.NOT, operand)
    if not isinstance(op, (ast.USub, ast.UAdd)):
        raise forbidden(op, span)
    _want_number(operand)
    is_negated = isinstance(op, ast.USub)
    kind: Kind = as_int(operand.kind) or operand.kind
    if isinstance(kind, IntKind) and kind.bounds and is_negated:
        low, high = kind.bounds
        kind = IntKind(-high, -low)
    value = constant_of(operand)
    if isinstance(value, (int, float)):
        return Constant(kind, span, -value if is_negated else value)
    if is_negated:
        return Unary(kind, span, Operator.NEGATE, operand)
    return operand if kind == operand.kind else Call(kind, span, "int", (operand,))


def want_binary(op: ast.operator, span: SourceSpan) -> Operator:
    """Raises ExpressionError for an operator that the language does not have."""
    if type(op) not in _OPERATORS:
        raise forbidden(op, span)
    return _OPERATORS[type(op)]


def binary(op: Operator, left: Node, right: Node, span: SourceSpan) -> Node:
    if op is Operator.ADD and isinstance(left.kind, StringKind) and isinstance(right.kind, StringKind):
        return folded(Binary(StringKind(), span, op, left, right))
    if isinstance(left.kind, TimeKind) or isinstance(right.kind, TimeKind):
        raise ExpressionError(span, Code.TYPE_MISMATCH, "times are not computed with", "use seconds(time) and back")
    _want_number(left)
    _want_number(right)
    if op in _DIVISIONS and constant_of(right) == 0:
        raise _division_by_zero(span)
    kind = _power(left.kind, right) if op is Operator.POWER else _arithmetic(op, left.kind, right.kind, span)
    return folded(Binary(within_bounds(kind, span), span, op, left, right))


def folded(made: Binary) -> Binary | Constant:
    """The literal that arithmetic of two literals gives, so that it is checked against the target."""
    left, right = constant_of(made.left), constant_of(made.right)
    if left is None or right is None:
        return made
    try:
        value = _COMPUTED[made.operator](left, right)
    except ArithmeticError as error:
        raise ExpressionError(made.span, Code.OUT_OF_RANGE, str(error)) from None
    if isinstance(value, float) and not math.isfinite(value):
        raise ExpressionError(
            made.span, Code.OUT_OF_RANGE, f"this is always {value}", f"write {value} if that is meant"
        )
    kind = IntKind(value, value) if isinstance(value, int) else made.kind
    return Constant(kind, made.span, value)


def _arithmetic(op: Operator, left: Kind, right: Kind, span: SourceSpan) -> IntKind | FloatKind:
    a, b = as_int(left), as_int(right)
    if a is None or b is None or op is Operator.DIVIDE:
        return FloatKind(max(float_bits(left), float_bits(right)))
    if a.bounds is None or b.bounds is None:
        return ANY_INT
    if b.bounds == (0, 0) and op in _DIVISIONS:
        raise _division_by_zero(span)
    extremes = _extremes(op, a.bounds, b.bounds)
    return IntKind(min(extremes), max(extremes))


def _extremes(op: Operator, left: tuple[int, int], right: tuple[int, int]) -> list[int]:
    """Integers that include the smallest and the largest value of `left op right`."""
    low, high = right
    if op in _MONOTONE:
        return [_COMPUTED[op](x, y) for x in left for y in right]
    if op is Operator.MODULO:  # has the divisor's sign
        return [min(low + 1, 0), max(high - 1, 0)]
    divisors = [y for y in (low, high, -1, 1) if low <= y <= high and y != 0]
    return [x // y for x in left for y in divisors]


def _power(base: Kind, exponent: Node) -> IntKind | FloatKind:
    value = constant_of(exponent)
    if not isinstance(value, int) or not 0 <= value <= LARGEST_EXPONENT:
        message = f"an exponent is a literal integer from 0 to {LARGEST_EXPONENT}"
        hint = "sqrt(x) is the root, 1 / x ** 2 has a negative exponent"
        raise ExpressionError(exponent.span, Code.FORBIDDEN_EXPRESSION, message, hint)
    number = as_int(base)
    if number is None:
        return FloatKind(float_bits(base))
    if number.bounds is None:
        return ANY_INT
    low, high = number.bounds
    extremes = [low**value, high**value, *[0] * (low < 0 < high)]
    return IntKind(min(extremes), max(extremes))


def _division_by_zero(span: SourceSpan) -> ExpressionError:
    return ExpressionError(span, Code.OUT_OF_RANGE, "division by zero")


def _want_number(operand: Node) -> None:
    if not isinstance(operand.kind, Number):
        hint = {BoolKind: "int() makes a number of a bool", StringKind: "str() makes text of a number"}
        raise ExpressionError(operand.span, Code.TYPE_MISMATCH, f"arithmetic takes numbers, not {operand.kind}",
                      hint.get(type(operand.kind), ""))  # fmt: skip


# truth


def boolean(op: ast.boolop, operands: Sequence[Node], span: SourceSpan) -> Logic:
    is_all = isinstance(op, ast.And)
    for operand in operands:
        want_bool(operand, "and" if is_all else "or")
    return Logic(BoolKind(), span, is_all, tuple(operands))


def comparison(ops: Sequence[ast.cmpop], operands: Sequence[Node], span: SourceSpan) -> Node:
    """`a < b < c` has two operators and three operands."""
    for op, (left, right) in zip(ops, pairwise(operands), strict=True):
        _want_comparable(op, left, right, span)
    if not any(isinstance(op, (ast.In, ast.NotIn)) for op in ops):
        return Compare(BoolKind(), span, tuple(_RELATIONS[type(op)] for op in ops), tuple(operands))
    tests = [_test(op, left, right, span) for op, (left, right) in zip(ops, pairwise(operands), strict=True)]
    return tests[0] if len(tests) == 1 else Logic(BoolKind(), span, True, tuple(tests))


def _test(op: ast.cmpop, left: Node, right: Node, span: SourceSpan) -> Compare | Contains:
    if isinstance(op, (ast.In, ast.NotIn)):
        return Contains(BoolKind(), span, left, right, isinstance(op, ast.NotIn))
    return Compare(BoolKind(), span, (_RELATIONS[type(op)],), (left, right))


def equality(left: Node, right: Node, span: SourceSpan) -> Node:
    """`left == right`."""
    return comparison([ast.Eq()], [left, right], span)


def _comparable_value(held: Node, written: Node) -> str:
    """A hint if an enum is compared with the quoted name of one of its values, else an empty string."""
    value = constant_of(written)
    if not isinstance(held.kind, EnumKind) or value is None:
        return ""
    enum = held.kind.enum
    return f"did you mean {enum}.{value} without quotes?" if value in dict(enum.values) else ""


def _want_comparable(op: ast.cmpop, left: Node, right: Node, span: SourceSpan) -> None:
    if isinstance(op, (ast.Is, ast.IsNot)):
        raise forbidden(op, span)
    if any(value != value for value in map(constant_of, (left, right))):  # noqa: PLR0124 - NaN
        raise ExpressionError(
            span, Code.TYPE_MISMATCH, "nan equals nothing, not even nan", "x != x is true where x is NaN"
        )
    other: Kind | None = right.kind
    if isinstance(op, (ast.In, ast.NotIn)):
        if not isinstance(right.kind, ListKind):
            raise ExpressionError(right.span, Code.TYPE_MISMATCH, f"'in' looks into a list, not into {right.kind}")
        other = right.kind.element
    if other is None or isinstance(left.kind, (MessageKind, ListKind)) or join(left.kind, other) is None:
        message = f"{left.kind} cannot be compared with {right.kind}"
        hint = _comparable_value(left, right) or _comparable_value(right, left)
        raise ExpressionError(span, Code.TYPE_MISMATCH, message, hint)
    if isinstance(op, (ast.Lt, ast.LtE, ast.Gt, ast.GtE)) and isinstance(left.kind, BoolKind):
        raise ExpressionError(span, Code.TYPE_MISMATCH, "bools have no order", "use == or !=")


def choice(test: Node, body: Node, orelse: Node, span: SourceSpan) -> Choice:
    """`body if test else orelse`, where `test` is a bool."""
    kind = join(body.kind, orelse.kind)
    if kind is None:
        message = f"this is {body.kind} or {orelse.kind}, which no field holds"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message)
    return Choice(kind, span, test, as_float(body, kind), as_float(orelse, kind))


def want_bool(operand: Node, word: str) -> None:
    if not isinstance(operand.kind, BoolKind):
        hint = "compare it, as in x != 0" if isinstance(operand.kind, Number) else ""
        raise ExpressionError(operand.span, Code.TYPE_MISMATCH, f"'{word}' takes a bool, not {operand.kind}", hint)

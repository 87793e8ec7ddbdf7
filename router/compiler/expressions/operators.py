"""Literals, lists and operators: what they take, the kind of the result, and the bounds of an integer result.

Operands are checked before.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Sequence
from itertools import pairwise

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
from router.compiler.expressions.scope import ExpressionError, Typed
from router.compiler.expressions.syntax import forbidden
from router.compiler.source import call
from router.errors import Code, SourceSpan

WIDEST = 512
"""Bits of the widest integer in an expression."""


def constant(value: object, span: SourceSpan) -> Typed:
    """A literal. Raises ExpressionError for one that the language does not have, or that is infinite."""
    match value:
        case bool():
            return Typed.at(span, BoolKind(), ast.Constant(value))
        case int():
            return Typed.at(span, within_bounds(IntKind(value, value), span), ast.Constant(value))
        case float():
            if not math.isfinite(value):
                raise ExpressionError(span, Code.OUT_OF_RANGE, "a literal this large is infinite")
            return Typed.at(span, FloatKind(32), ast.Constant(value))
        case str():
            return Typed.at(span, StringKind(), ast.Constant(value))
        case _:
            raise forbidden(ast.Constant(None), span)


def within_bounds(kind: Kind, span: SourceSpan) -> Kind:
    """Refuse integers of more than WIDEST bits, so that powers of powers do not take all memory."""
    if isinstance(kind, IntKind) and kind.bounds and max(bound.bit_length() for bound in kind.bounds) > WIDEST:
        raise ExpressionError(span, Code.OUT_OF_RANGE, f"an integer has at most {WIDEST} bits")
    return kind


def folded(result: Typed) -> Typed:
    """The literal that arithmetic of two literals gives, so that it is checked against the target."""
    try:
        value = eval(compile(ast.Expression(result.node), "<literal>", "eval"), {})  # noqa: S307 - two literals
    except ArithmeticError as error:
        raise ExpressionError(result.span, Code.OUT_OF_RANGE, str(error)) from None
    if isinstance(value, float) and not math.isfinite(value):
        raise ExpressionError(
            result.span, Code.OUT_OF_RANGE, f"this is always {value}", f"write {value} if that is meant"
        )
    kind = IntKind(value, value) if isinstance(value, int) else result.kind
    return Typed.at(result.span, kind, ast.Constant(value))


def list_of(items: Sequence[Typed], span: SourceSpan) -> Typed:
    """A list literal, whose elements have one kind in common."""
    element: Kind | None = items[0].kind if items else None
    for item in items[1:]:
        element = join(element, item.kind) if element else None
        if element is None:
            raise ExpressionError(item.span, Code.TYPE_MISMATCH, f"a list of {items[0].kind} cannot hold {item.kind}")
    made = ast.List([item.node for item in items], ast.Load())
    return Typed.at(span, ListKind(element, len(items)), made, items=tuple(items))


def element_of(holder: Typed, index: Typed, span: SourceSpan) -> Typed:
    """`holder[index]`."""
    kind, position = holder.kind, index.constant
    if not isinstance(kind, ListKind) or kind.element is None:
        raise ExpressionError(span, Code.TYPE_MISMATCH, f"a {kind} has no elements", "only lists are indexed")
    if not isinstance(position, int) or isinstance(position, bool) or position < 0:
        raise ExpressionError(index.span, Code.FORBIDDEN_EXPRESSION, "an index is a literal integer from 0")
    if kind.length is not None and position >= kind.length:
        raise ExpressionError(index.span, Code.OUT_OF_RANGE, f"index {position} of {kind.length} elements")
    return Typed.at(span, kind.element, ast.Subscript(holder.node, index.node, ast.Load()))


LARGEST_EXPONENT = 8

_MONOTONE: dict[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}
"""Operators whose result is extreme at the extremes of the operands."""

_DIVISIONS = (ast.Div, ast.FloorDiv, ast.Mod)


# arithmetic


def as_float(operand: Typed, kind: Kind) -> Typed:
    """An operand of what gives a value of `kind`: where that is a float, an integer becomes one."""
    if not isinstance(kind, FloatKind) or as_int(operand.kind) is None:
        return operand
    node = operand.node
    made = ast.Constant(float(node.value)) if isinstance(node, ast.Constant) else call("float64", node)  # type: ignore[arg-type]
    return Typed.at(operand.span, kind, made)


def unary(op: ast.unaryop, operand: Typed, span: SourceSpan) -> Typed:
    if isinstance(op, ast.Not):
        want_bool(operand, "not")
        return Typed.at(span, BoolKind(), ast.UnaryOp(op, operand.node))
    if not isinstance(op, (ast.USub, ast.UAdd)):
        raise forbidden(op, span)
    _want_number(operand)
    negative = isinstance(op, ast.USub)
    kind: Kind = as_int(operand.kind) or operand.kind
    if isinstance(kind, IntKind) and kind.bounds and negative:
        low, high = kind.bounds
        kind = IntKind(-high, -low)
    if isinstance(operand.constant, (int, float)):
        return Typed.at(span, kind, ast.Constant(-operand.constant if negative else operand.constant))
    return Typed.at(span, kind, ast.UnaryOp(op, operand.node))


def want_binary(op: ast.operator, span: SourceSpan) -> None:
    """Raises ExpressionError for an operator that the language does not have."""
    if not isinstance(op, (*_MONOTONE, *_DIVISIONS, ast.Pow)):
        raise forbidden(op, span)


def binary(op: ast.operator, left: Typed, right: Typed, span: SourceSpan) -> Typed:
    made = ast.BinOp(left.node, op, right.node)
    if isinstance(op, ast.Add) and isinstance(left.kind, StringKind) and isinstance(right.kind, StringKind):
        return Typed.at(span, StringKind(), made)
    if isinstance(left.kind, TimeKind) or isinstance(right.kind, TimeKind):
        raise ExpressionError(span, Code.TYPE_MISMATCH, "times are not computed with", "use seconds(time) and back")
    _want_number(left)
    _want_number(right)
    if isinstance(op, _DIVISIONS) and right.constant == 0:
        raise _division_by_zero(span)
    kind = _power(left.kind, right) if isinstance(op, ast.Pow) else _arithmetic(op, left.kind, right.kind, span)
    result = Typed.at(span, within_bounds(kind, span), made)
    return result if left.constant is None or right.constant is None else folded(result)


def _arithmetic(op: ast.operator, left: Kind, right: Kind, span: SourceSpan) -> Kind:
    a, b = as_int(left), as_int(right)
    if a is None or b is None or isinstance(op, ast.Div):
        return FloatKind(max(float_bits(left), float_bits(right)))
    if a.bounds is None or b.bounds is None:
        return ANY_INT
    if b.bounds == (0, 0) and isinstance(op, _DIVISIONS):
        raise _division_by_zero(span)
    extremes = _extremes(op, a.bounds, b.bounds)
    return IntKind(min(extremes), max(extremes))


def _extremes(op: ast.operator, left: tuple[int, int], right: tuple[int, int]) -> list[int]:
    """Integers that include the smallest and the largest value of `left op right`."""
    low, high = right
    if compute := _MONOTONE.get(type(op)):
        return [compute(x, y) for x in left for y in right]
    if isinstance(op, ast.Mod):  # has the divisor's sign
        return [min(low + 1, 0), max(high - 1, 0)]
    divisors = [y for y in (low, high, -1, 1) if low <= y <= high and y != 0]
    return [x // y for x in left for y in divisors]


def _power(base: Kind, exponent: Typed) -> Kind:
    value = exponent.constant
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


def _want_number(operand: Typed) -> None:
    if not isinstance(operand.kind, Number):
        hint = {BoolKind: "int() makes a number of a bool", StringKind: "str() makes text of a number"}
        raise ExpressionError(operand.span, Code.TYPE_MISMATCH, f"arithmetic takes numbers, not {operand.kind}",
                      hint.get(type(operand.kind), ""))  # fmt: skip


# truth


def boolean(op: ast.boolop, operands: Sequence[Typed], span: SourceSpan) -> Typed:
    for operand in operands:
        want_bool(operand, "and" if isinstance(op, ast.And) else "or")
    return Typed.at(span, BoolKind(), ast.BoolOp(op, [operand.node for operand in operands]))


def comparison(ops: list[ast.cmpop], operands: Sequence[Typed], span: SourceSpan) -> Typed:
    """`a < b < c` has two operators and three operands."""
    for op, (left, right) in zip(ops, pairwise(operands), strict=True):
        _want_comparable(op, left, right, span)
    first, *others = [operand.node for operand in operands]
    return Typed.at(span, BoolKind(), ast.Compare(first, ops, others))


def _comparable_value(held: Typed, written: Typed) -> str:
    """A hint if an enum is compared with the quoted name of one of its values, else an empty string."""
    if not isinstance(held.kind, EnumKind) or not isinstance(written.node, ast.Constant):
        return ""
    enum, value = held.kind.enum, written.node.value
    return f"did you mean {enum}.{value} without quotes?" if value in dict(enum.values) else ""


def _want_comparable(op: ast.cmpop, left: Typed, right: Typed, span: SourceSpan) -> None:
    if isinstance(op, (ast.Is, ast.IsNot)):
        raise forbidden(op, span)
    if any(isinstance(operand.constant, float) and math.isnan(operand.constant) for operand in (left, right)):
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


def choice(test: Typed, body: Typed, orelse: Typed, span: SourceSpan) -> Typed:
    """`body if test else orelse`, where `test` is a bool."""
    kind = join(body.kind, orelse.kind)
    if kind is None:
        message = f"this is {body.kind} or {orelse.kind}, which no field holds"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message)
    return Typed.at(span, kind, ast.IfExp(test.node, *[as_float(each, kind).node for each in (body, orelse)]))


def want_bool(operand: Typed, word: str) -> None:
    if not isinstance(operand.kind, BoolKind):
        hint = "compare it, as in x != 0" if isinstance(operand.kind, Number) else ""
        raise ExpressionError(operand.span, Code.TYPE_MISMATCH, f"'{word}' takes a bool, not {operand.kind}", hint)

"""Expressions as Python syntax, for handlers and for what runs once: deadmen, `tap --where`.

A payload is read through attributes of `m`. A serialized ROS message is read before its expressions run: `values` has
the variables with its fields (`CdrReads.values`).
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Mapping

from router.compiler.expressions.kinds import INT64, UINT64, EnumKind, FloatKind, IntKind, Kind, as_int
from router.compiler.expressions.tree import (
    MESSAGE,
    Binary,
    Call,
    Choice,
    Compare,
    Constant,
    Contains,
    Each,
    Element,
    Listed,
    Logic,
    Node,
    Operator,
    Path,
    Present,
    Read,
    Relation,
    Unary,
    Variable,
    path_of,
)
from router.compiler.source import attribute, call, load, placed
from router.types.model import Field, List

Values = Mapping[Path, ast.expr]
"""What stands for fields of the source message, by path."""

NO_VALUES: Values = {}

_OPERATORS: Mapping[Operator, type[ast.operator]] = {
    Operator.ADD: ast.Add,
    Operator.SUBTRACT: ast.Sub,
    Operator.MULTIPLY: ast.Mult,
    Operator.DIVIDE: ast.Div,
    Operator.FLOOR_DIVIDE: ast.FloorDiv,
    Operator.MODULO: ast.Mod,
    Operator.POWER: ast.Pow,
}
_RELATIONS: Mapping[Relation, type[ast.cmpop]] = {
    Relation.EQUAL: ast.Eq,
    Relation.UNEQUAL: ast.NotEq,
    Relation.LESS: ast.Lt,
    Relation.LESS_OR_EQUAL: ast.LtE,
    Relation.MORE: ast.Gt,
    Relation.MORE_OR_EQUAL: ast.GtE,
}
_EXACT = 1 << 53
"""Up to here every integer is a double."""


def render(node: Node, values: Values = NO_VALUES) -> ast.expr:
    """The Python syntax of an expression, with positions in the table."""
    return placed(_made(node, values), node.span)


def _made(node: Node, values: Values) -> ast.expr:  # noqa: C901, PLR0912 - a case a node
    match node:
        case Constant():
            return ast.Constant(node.value)
        case Variable() | Read():
            return _read(node, values)
        case Present():
            has_field = attribute(render(node.holder, values), "HasField")
            return ast.Call(has_field, [ast.Constant(node.field.name)], [])
        case Element():
            return ast.Subscript(render(node.values, values), ast.Constant(node.index), ast.Load())
        case Listed():
            return ast.List([render(item, values) for item in node.items], ast.Load())
        case Each():
            return _comprehension(node, values)
        case Unary(operator=Operator.NOT):
            return ast.UnaryOp(ast.Not(), render(node.operand, values))
        case Unary():
            negative = ast.UnaryOp(ast.USub(), render(node.operand, values))
            return _fit(negative, node.kind) if node.is_checked else negative
        case Binary():
            return _binary(node, values)
        case Compare():
            first, *others = [render(operand, values) for operand in node.operands]
            return ast.Compare(first, [_RELATIONS[relation]() for relation in node.relations], others)
        case Contains():
            found = call("contains", render(node.sought, values), render(node.values, values))
            return ast.UnaryOp(ast.Not(), found) if node.is_negated else found
        case Logic():
            operands = [render(operand, values) for operand in node.operands]
            return ast.BoolOp(ast.And() if node.is_all else ast.Or(), operands)
        case Choice():
            return ast.IfExp(*(render(each, values) for each in (node.test, node.body, node.orelse)))
        case Call():
            return _call(node, values)


def _read(node: Variable | Read, values: Values) -> ast.expr:
    path = path_of(node)
    if path is not None and path in values:
        return copy.deepcopy(values[path])
    if isinstance(node, Variable):
        return load("m" if node.name == MESSAGE else node.name)
    return _value_of(render(node.holder, values), node.field)


def _value_of(message: ast.expr, member: Field) -> ast.expr:
    """A field of a message object."""
    value = attribute(message, member.name)
    if not member.is_unchecked:
        return value
    return call("checked_texts" if isinstance(member.type, List) else "checked_text", value)


def lists_of(lists: tuple[tuple[str, Node], ...], values: Values = NO_VALUES) -> tuple[str, ast.expr]:
    """The target of a loop over one or several lists, and what it iterates over."""
    rendered = [render(each, values) for _, each in lists]
    names = ", ".join(name for name, _ in lists)
    return names, rendered[0] if len(rendered) == 1 else call("side_by_side", *rendered)


def _comprehension(node: Each, values: Values) -> ast.expr:
    names, iterated = lists_of(node.lists, values)
    targets: list[ast.expr] = [ast.Name(name, ast.Store()) for name in names.split(", ")]
    target = targets[0] if len(targets) == 1 else ast.Tuple(targets, ast.Store())
    return ast.ListComp(render(node.element, values), [ast.comprehension(target, iterated, [], 0)])


def _binary(node: Binary, values: Values) -> ast.expr:
    operands = [render(node.left, values), render(node.right, values)]
    if node.operator is Operator.DIVIDE and not (_is_exact(node.left.kind) and _is_exact(node.right.kind)):
        operands = [call("float64", operand) for operand in operands]
    left, right = operands
    made = ast.BinOp(left, _OPERATORS[node.operator](), right)
    return _fit(made, node.kind) if node.is_checked else made


def _is_exact(kind: Kind) -> bool:
    """Whether a number is a double as it is."""
    integer = as_int(kind)
    return integer is None or (integer.low >= -_EXACT and integer.high <= _EXACT)


def _fit(made: ast.expr, kind: Kind) -> ast.expr:
    assert isinstance(kind, IntKind)  # noqa: S101 - only integers are checked
    return call("fit", made, ast.Constant(kind.low), ast.Constant(kind.high))


def _call(node: Call, values: Values) -> ast.expr:
    arguments = [render(argument, values) for argument in node.arguments]
    match node.function:
        case "named":
            return call("named", *arguments, _numbers(node.kind))
        case "member":
            return call("member", *arguments, ast.Tuple(_numbers(node.kind).values, ast.Load()))
        case "sum" if isinstance(node.kind, FloatKind):
            return call("total", *arguments)
        case "sum":
            bounds = UINT64 if _is_unsigned(node.kind) else INT64
            return call("whole_total", *arguments, ast.Constant(bounds.low), ast.Constant(bounds.high))
        case _:
            return call(node.function, *arguments)


def _numbers(kind: Kind) -> ast.Dict:
    """The values of an enum by name."""
    assert isinstance(kind, EnumKind)  # noqa: S101 - what these functions give
    values = kind.enum.values
    return ast.Dict([ast.Constant(name) for name, _ in values], [ast.Constant(number) for _, number in values])


def _is_unsigned(kind: Kind) -> bool:
    return isinstance(kind, IntKind) and kind.high > INT64.high

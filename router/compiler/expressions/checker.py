"""Checks an expression, innermost node first, and returns a typed tree.

The rules are in `names`, `operators`, `lists` and `calls`, and raise ExpressionError for the first mistake.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from router.compiler.expressions import lists, operators
from router.compiler.expressions.calls import call_of, called_name, function_named
from router.compiler.expressions.functions import HAS
from router.compiler.expressions.kinds import BoolKind, EnumKind, StringKind
from router.compiler.expressions.names import (
    constant_at,
    constant_path,
    field_path,
    is_null,
    is_source,
    member_of,
    named,
    no_null,
    presence,
    require_senders,
    state_named,
    whole_message,
)
from router.compiler.expressions.operators import constant
from router.compiler.expressions.scope import ExpressionError, Scope
from router.compiler.expressions.syntax import Parsed, forbidden
from router.compiler.expressions.tree import Call, Constant, Node, Operator, constant_of
from router.errors import Code, Located, SourceSpan, did_you_mean
from router.table.model.expressions import Choices, Expression
from router.table.nodes import TextSpan
from router.types.model import List, String, Type

DEEPEST = 60
"""Maximum nesting of an expression: functions on syntax trees are recursive, both ours and Python's."""


MOST_CHOICES = 100
"""Maximum number of values of a map, which becomes a chain of choices nested this deep."""


def check(expression: Expression, scope: Scope, expected: Type | None = None) -> Node:
    """Return the typed tree of an expression. Raises ExpressionError.

    `expected` is the type of the field to be filled: clamp() and wrap() take their bounds from it, and bare names may
    be values of an enum.
    """
    if expression.literal:
        return constant(expression.text, expression.span)
    if expression.choices is not None:
        return _chosen(expression.choices, expression.span, scope, expected)
    if expression.items is not None:
        items = [check(item, scope, _element(expected)) for item in expression.items]
        return lists.list_of(items, expression.span)
    text = Parsed(expression, scope.field_names())
    return _Checker(text, scope).check(text.tree, expected)


def _chosen(choices: Choices, span: SourceSpan, scope: Scope, expected: Type | None) -> Node:
    """Return a chain of choices, which compare the subject with each key.

    Without `else`, values that are not in the map are rejected at run time.
    """
    if len(choices.values) > MOST_CHOICES:
        raise ExpressionError(span, Code.EXPRESSION_SYNTAX, f"a map has at most {MOST_CHOICES} values")
    subject = check(choices.subject, scope)
    keys: list[Node] = [_key(name, subject, choices, scope) for name, _ in choices.values]
    _require_different(choices, keys)
    values = [check(value, scope, expected) for _, value in choices.values]
    if choices.otherwise is not None:
        result = check(choices.otherwise, scope, expected)
    else:
        _require_all(subject, keys, span, scope)
        result, last = values[-1], keys[-1]
        if isinstance(subject.kind, EnumKind):
            keys[-1] = Call(last.kind, last.span, "fit", (subject, last, last))
    for (name, _), key, value in reversed(list(zip(choices.values, keys, values, strict=True))):
        result = operators.choice(operators.equality(subject, key, name.span), value, result, value.span, scope)
    return replace(result, span=span)


def _key(name: Located[str], subject: Node, choices: Choices, scope: Scope) -> Node:
    """Return the value of a key of a map: a name of the subject's enum, or a constant."""
    if isinstance(subject.kind, EnumKind):
        values = dict(subject.kind.enum.values)
        if name.value in values:
            return Constant(subject.kind, name.span, values[name.value])
        message = f"'{subject.kind.enum.name}' has no value '{name.value}'"
        taken = {other.value for other, _ in choices.values}
        free = {value: number for value, number in values.items() if value not in taken}
        raise ExpressionError(name.span, Code.UNKNOWN_ENUM_VALUE, message, _key_hint(name.value, free))
    if isinstance(subject.kind, StringKind):
        key = Constant(StringKind(), name.span, name.value)
        require_senders([subject, key], scope)
        return key
    if name.value in scope.message.constants:
        return constant(scope.message.constants[name.value], name.span)
    checked = check(Expression(name.value, TextSpan(name.span)), scope)
    if constant_of(checked) is None:
        message = f"'{name.value}' is not a constant"
        raise ExpressionError(name.span, Code.TYPE_MISMATCH, message, "the keys of a map are values, not fields")
    return checked


def _key_hint(name: str, values: Mapping[str, int]) -> str:
    """Return a hint for a key that is not a value of the enum. `values` are those that the map lacks."""
    short = name.replace("::", ".").rpartition(".")[2]
    named = [short] if short in values else [value for value, number in values.items() if str(number) == name]
    if named:
        return f"did you mean '{named[0]}'?"
    return "write `else` for all other values" if name in ("default", "_", "*", "other") else did_you_mean(name, values)


def _require_different(choices: Choices, keys: Sequence[Node]) -> None:
    """Reject a map in which two keys have the same value, such as two names of one enum number."""
    names: dict[object, str] = {}
    for (name, _), key in zip(choices.values, keys, strict=True):
        first = names.setdefault(constant_of(key), name.value)
        if first != name.value:
            message = f"'{name.value}' is the same value as '{first}'"
            raise ExpressionError(name.span, Code.DUPLICATE_KEY, message, "remove one of the two")


def _require_all(subject: Node, keys: Sequence[Node], span: SourceSpan, scope: Scope) -> None:
    """Reject a map without `else` that does not cover all values, or whose subject has no list of values."""
    covered = {constant_of(key) for key in keys}
    if isinstance(subject.kind, BoolKind) and covered == {True, False}:
        return
    if is_source(subject) and scope.sources and covered == {*scope.sources}:
        return
    if not isinstance(subject.kind, EnumKind):
        message = f"the map does not cover all values of {subject.kind}"
        raise ExpressionError(span, Code.MISSING_ENUM_VALUE, message, "add `else: VALUE`")
    missing = [name for name, number in subject.kind.enum.values if number not in covered]
    if missing:
        names = ", ".join(missing)
        message, hint = f"the map has no value for {names}", "add them, or `else: VALUE`"
        raise ExpressionError(span, Code.MISSING_ENUM_VALUE, message, hint)


def _element(expected: Type | None) -> Type | None:
    return expected.element if isinstance(expected, List) else None


@dataclass(slots=True)
class _Checker:
    """Checks one expression. Each method takes a syntax node and returns it checked and resolved."""

    text: Parsed
    scope: Scope
    depth: int = 0

    def check(self, node: ast.expr, expected: Type | None = None) -> Node:
        span = self.text.span(node)
        self.depth += 1
        if self.depth > DEEPEST:
            raise ExpressionError(span, Code.EXPRESSION_SYNTAX, "not an expression: nested too deeply")
        checked = self._rule(node, span, expected)
        self.depth -= 1
        return checked

    def _rule(  # noqa: C901, PLR0912 - one case per syntax
        self, node: ast.expr, span: SourceSpan, expected: Type | None
    ) -> Node:
        match node:
            case ast.Constant():
                return operators.constant(node.value, span)
            case ast.List():
                return lists.list_of([self.check(item, _element(expected)) for item in node.elts], span)
            case ast.Name():
                return named(node.id, span, self.scope, expected)
            case ast.Attribute() if state := state_named(node, self.text, self.scope):
                return state
            case ast.Attribute() if path := constant_path(node, self.scope):
                return constant_at(path, node, self.text, self.scope)
            case ast.Attribute():
                holder = whole_message(node.value, self.text, self.scope) or self.check(node.value)
                return member_of(holder, node, self.text, self.scope)
            case ast.Subscript():
                return lists.item_of(self.check(node.value), self.check(node.slice), span, self.scope)
            case ast.UnaryOp():
                return self._unary(node.op, self.check(node.operand), span)
            case ast.BinOp():
                return self._binary(operators.require_binary(node.op, span), node, span)
            case ast.BoolOp():
                return operators.boolean(node.op, [self.check(value) for value in node.values], span)
            case ast.Compare() if (other := self._beside_null(node)) is not None:
                is_equal = isinstance(node.ops[0], (ast.Eq, ast.Is))
                raise no_null(self.check(other), ast.unparse(other), span, is_equal=is_equal)
            case ast.Compare():
                operands = self._compared([node.left, *node.comparators])
                require_senders(operands, self.scope)
                return operators.comparison(node.ops, operands, span, self.scope)
            case ast.IfExp():
                test = self.check(node.test)
                operators.require_bool(test, "if")
                body, orelse = self.check(node.body, expected), self.check(node.orelse, expected)
                return operators.choice(test, body, orelse, span, self.scope)
            case ast.Call():
                return self._call(node, span, expected)
            case _:
                raise forbidden(node, span)

    def _compared(self, operands: Sequence[ast.expr]) -> list[Node]:
        """Check the operands of a comparison. Beside a state with an enum, bare names are values of the enum."""
        kinds = [state.kind for each in operands if (state := state_named(each, self.text, self.scope))]
        scalar: Type | None = next((kind.enum for kind in kinds if isinstance(kind, EnumKind)), None)
        if scalar is None and any(isinstance(kind, StringKind) for kind in kinds):
            scalar = String()
        if scalar is None:
            return [self.check(operand) for operand in operands]
        expected: Mapping[type[ast.expr], Type] = {ast.Name: scalar, ast.List: List(scalar)}
        return [self.check(operand, expected.get(type(operand))) for operand in operands]

    def _beside_null(self, node: ast.Compare) -> ast.expr | None:
        """Return the `x` of `x == null`, `None != x` and `x is None`; None for other comparisons."""
        if len(node.ops) > 1 or not isinstance(node.ops[0], (ast.Eq, ast.NotEq, ast.Is, ast.IsNot)):
            return None
        left, right = node.left, node.comparators[0]
        nulls = [is_null(side, self.scope) for side in (left, right)]
        return None if nulls[0] == nulls[1] else left if nulls[1] else right

    def _unary(self, op: ast.unaryop, operand: Node, span: SourceSpan) -> Node:
        if isinstance(op, ast.Not):
            return operators.unary(op, operand, span)
        return lists.elementwise(lambda parts: operators.unary(op, parts[0], span), [operand], span, self.scope)

    def _binary(self, op: Operator, node: ast.BinOp, span: SourceSpan) -> Node:
        operands = [self.check(node.left), self.check(node.right)]
        return lists.elementwise(
            lambda parts: operators.binary(op, parts[0], parts[1], span), operands, span, self.scope
        )

    def _call(self, node: ast.Call, span: SourceSpan, expected: Type | None) -> Node:
        name = called_name(node, self.text)
        if name == HAS:
            return self._has(node, span)
        function = function_named(name, self.text.span(node.func))
        arguments = [self.check(argument) for argument in node.args]
        return call_of(function, arguments, span, self.scope, expected)

    def _has(self, node: ast.Call, span: SourceSpan) -> Node:
        """Check `has(field)`, which takes the path of its argument instead of the value."""
        path = field_path(node.args[0], self.scope) if len(node.args) == 1 else None
        if not path:
            raise ExpressionError(span, Code.WRONG_ARGUMENTS, "has() takes one field")
        return presence(self.check(node.args[0]), path, span)

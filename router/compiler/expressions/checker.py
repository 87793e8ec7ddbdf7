"""Walks an expression, innermost first, and lets the rules make checked Python of what the user wrote."""

from __future__ import annotations

import ast
from dataclasses import dataclass

from router.compiler.expressions import calls, literals, names, operators
from router.compiler.expressions.forbidden import forbidden
from router.compiler.expressions.parsing import Parsed
from router.compiler.expressions.scope import Scope
from router.compiler.expressions.typed import Finding, Typed
from router.compiler.functions import HAS
from router.errors import Code, SourceSpan
from router.table.model import Expression
from router.types.model import List, Type

DEEPEST = 60
"""How deep an expression may nest: what handles syntax trees, ours and Python's own, does so recursively."""


def check(expression: Expression, scope: Scope, expected: Type | None = None) -> Typed:
    """Raises Finding. `expected` is the field to be filled: clamp() and wrap() take bounds of it, bare names values."""
    if expression.items is not None:
        items = [check(item, scope, _element(expected)) for item in expression.items]
        typed = literals.list_of(items, expression.span)
    else:
        text = Parsed(expression)
        typed = _Checker(text, scope).check(text.tree, expected)
    if typed.path is None:
        scope.reads.need_objects(typed.node)
    return typed


def _element(expected: Type | None) -> Type | None:
    return expected.element if isinstance(expected, List) else None


@dataclass(slots=True)
class _Checker:
    """One expression. Each method takes a syntax node of the user's and returns it checked and resolved."""

    text: Parsed
    scope: Scope
    depth: int = 0

    def check(self, node: ast.expr, expected: Type | None = None) -> Typed:
        span = self.text.span(node)
        self.depth += 1
        if self.depth > DEEPEST:
            raise Finding(span, Code.EXPRESSION_SYNTAX, "not an expression: nested too deeply")
        typed = self._rule(node, span, expected)
        self.depth -= 1
        return typed

    def _rule(  # noqa: C901, PLR0912 - a case a syntax
        self, node: ast.expr, span: SourceSpan, expected: Type | None
    ) -> Typed:
        match node:
            case ast.Constant():
                return literals.constant(node.value, span)
            case ast.List():
                return literals.list_of([self.check(item, _element(expected)) for item in node.elts], span)
            case ast.Name():
                return names.named(node.id, span, self.scope, expected)
            case ast.Attribute() if path := names.constant_path(node, self.scope):
                return names.constant_of(path, node, self.text, self.scope)
            case ast.Attribute():
                return names.field_of(self.check(node.value), node, self.text, self.scope)
            case ast.Subscript():
                return literals.element_of(self.check(node.value), self.check(node.slice), span)
            case ast.UnaryOp():
                return operators.unary(node.op, self.check(node.operand), span)
            case ast.BinOp():
                operators.want_binary(node.op, span)
                return operators.binary(node.op, self.check(node.left), self.check(node.right), span)
            case ast.BoolOp():
                return operators.boolean(node.op, [self.check(value) for value in node.values], span)
            case ast.Compare():
                operands = [self.check(operand) for operand in (node.left, *node.comparators)]
                return operators.comparison(node.ops, operands, span)
            case ast.IfExp():
                test = self.check(node.test)
                operators.want_bool(test, "if")
                return operators.choice(test, self.check(node.body, expected), self.check(node.orelse, expected), span)
            case ast.Call():
                return self._call(node, span, expected)
            case _:
                raise forbidden(node, span)

    def _call(self, node: ast.Call, span: SourceSpan, expected: Type | None) -> Typed:
        name = calls.called_name(node, self.text)
        if name == HAS:
            return self._has(node, span)
        function = calls.function_named(name, self.text.span(node.func))
        return calls.call_of(function, [self.check(argument) for argument in node.args], span, expected)

    def _has(self, node: ast.Call, span: SourceSpan) -> Typed:
        """Looks at a field rather than at its value, so the argument's path counts; checked it is all the same."""
        path = names.field_path(node.args[0], self.scope) if len(node.args) == 1 else None
        if not path:
            raise Finding(span, Code.WRONG_ARGUMENTS, "has() takes one field")
        argument = self.check(node.args[0])
        return names.presence(path, argument.span, span, self.scope)

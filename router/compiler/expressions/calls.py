"""Calls of functions: the number and kinds of arguments, and calls with lists."""

from __future__ import annotations

import ast
from collections.abc import Sequence

from router.compiler.expressions import foreign_syntax
from router.compiler.expressions.functions import FUNCTIONS, HAS, Function, Parameter
from router.compiler.expressions.kinds import FloatKind, fields_hint, is_list
from router.compiler.expressions.lists import as_kind, as_value, elementwise
from router.compiler.expressions.scope import ExpressionError, Scope
from router.compiler.expressions.syntax import Parsed
from router.compiler.expressions.tree import Call, Node, whole
from router.errors import Code, SourceSpan, did_you_mean, plural
from router.types.model import Int, List, Type


def called_name(node: ast.Call, text: Parsed) -> str:
    """Return the name of the function. Raises ExpressionError unless the call has the form `name(a, b)`."""
    if not isinstance(node.func, ast.Name):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        foreign = foreign_syntax.FUNCTIONS.get(name.lower())
        known = f"write {FUNCTIONS[name].signature}" if name in FUNCTIONS else foreign
        known = "write has(x)" if name == HAS else _of_each(node) or known
        hint = known or did_you_mean("", FUNCTIONS)
        message = "expressions can call only their own functions"
        raise ExpressionError(text.span(node.func), Code.FORBIDDEN_EXPRESSION, message, hint)
    if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
        message = f"{node.func.id}() takes its arguments by position"
        hint = f"write {FUNCTIONS[node.func.id].signature}" if node.func.id in FUNCTIONS else ""
        raise ExpressionError(text.span(node), Code.WRONG_ARGUMENTS, message, hint)
    return node.func.id


def _of_each(node: ast.Call) -> str:
    """Return a hint for `cells.map(mv)` and `cells.map(lambda cell: cell.mv)`; empty for anything else."""
    if not (isinstance(node.func, ast.Attribute) and node.func.attr == "map" and len(node.args) == 1):
        return ""
    field = node.args[0].body if isinstance(node.args[0], ast.Lambda) else node.args[0]
    name = field.attr if isinstance(field, ast.Attribute) else field.id if isinstance(field, ast.Name) else "FIELD"
    return f"write {ast.unparse(node.func.value)}.{name} for this field of each element"


def function_named(name: str, span: SourceSpan) -> Function:
    function = FUNCTIONS.get(name)
    if function is None:
        hint = foreign_syntax.FUNCTIONS.get(name.lower()) or did_you_mean(name, [*FUNCTIONS, HAS])
        raise ExpressionError(span, Code.UNKNOWN_FUNCTION, f"there is no function '{name}'", hint)
    return function


def call_of(
    function: Function, arguments: Sequence[Node], span: SourceSpan, scope: Scope, expected: Type | None
) -> Node:
    """Return the call as a checked expression. Omitted bounds are those of the field `expected`."""
    if function.of_list is not None and len(arguments) == 1 and is_list(arguments[0].kind):
        return _whole_list(function, arguments[0], span, scope)
    if function.optional and len(arguments) == len(function.parameters) - function.optional:
        filled = expected.element if isinstance(expected, List) and is_list(arguments[0].kind) else expected
        arguments = [*arguments, *_bounds(function, span, filled)]
    _require_count(function, len(arguments), span)
    return elementwise(lambda parts: _call_of_scalars(function, parts, span, scope), arguments, span, scope)


def _whole_list(function: Function, argument: Node, span: SourceSpan, scope: Scope) -> Call:
    assert function.of_list is not None  # noqa: S101 - see call_of
    kind = function.of_list(argument.kind)
    if kind is None:
        message = f"{function.name}() takes a list of numbers, not {argument.kind}"
        raise ExpressionError(argument.span, Code.WRONG_ARGUMENTS, message)
    return Call(kind, span, function.name, (as_value(argument, scope),))


def _call_of_scalars(function: Function, arguments: Sequence[Node], span: SourceSpan, scope: Scope) -> Call:
    _require_accepted(function, arguments)
    try:
        kind = function.result(arguments)
    except ValueError as error:
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, f"{function.name}(): {error}") from None
    if function.gives_an_argument and isinstance(kind, FloatKind):
        arguments = [as_kind(argument, kind, scope) for argument in arguments]
    becomes = [parameter.becomes for parameter in _parameters(function, len(arguments))]
    converted = [
        as_kind(argument, kind, scope) if kind else argument for argument, kind in zip(arguments, becomes, strict=True)
    ]
    return Call(kind, span, function.name, tuple(converted))


def _parameters(function: Function, count: int) -> list[Parameter]:
    """Return the parameters of a call with `count` arguments."""
    return [*function.parameters, *[function.parameters[-1]] * (count - len(function.parameters))]


def _bounds(function: Function, span: SourceSpan, expected: Type | None) -> list[Node]:
    if not isinstance(expected, Int):
        message = f"{function.name}() needs bounds here, because it fills no integer field"
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, message, f"write {function.name}(x, low, high)")
    return [whole(expected.low, span), whole(expected.high, span)]


def _require_count(function: Function, count: int, span: SourceSpan) -> None:
    takes = len(function.parameters)
    if count < takes or (count > takes and not function.variadic):
        wanted = plural(takes, "argument") + " or more, or one list" * function.variadic
        message = f"{function.name}() takes {wanted}, not {count}"
        hint = _OF_MORE.get(function.name, "") if count > takes else ""
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, message, hint or f"write {function.signature}")


_OF_MORE = {"round": "write round(x * 100) / 100 for two decimals, text(x, 2) for text"}
_OF_FLOATS = {"int": foreign_syntax.INTEGERS, "str": foreign_syntax.DECIMALS, "wrap": foreign_syntax.WRAPPED}


def _require_accepted(function: Function, arguments: Sequence[Node]) -> None:
    for parameter, argument in zip(_parameters(function, len(arguments)), arguments, strict=True):
        if not isinstance(argument.kind, parameter.accepts):
            message = f"{function.name}() takes {parameter.wanted} as '{parameter.name}', not {argument.kind}"
            hint = _OF_FLOATS.get(function.name, "") if isinstance(argument.kind, FloatKind) else ""
            hint = hint or fields_hint(argument.kind)
            raise ExpressionError(argument.span, Code.WRONG_ARGUMENTS, message, hint)

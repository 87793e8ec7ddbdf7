"""Calls of the language's functions: which function it is, what it is given, of which kind the result is."""

from __future__ import annotations

import ast
from collections.abc import Sequence

from router.compiler.expressions.parsing import Parsed
from router.compiler.expressions.typed import Finding, Typed
from router.compiler.functions import FUNCTIONS, HAS, Function
from router.compiler.kinds import IntKind
from router.compiler.syntax import call
from router.errors import Code, SourceSpan, did_you_mean
from router.types.model import Int, Type


def called_name(node: ast.Call, text: Parsed) -> str:
    """The name in front of the brackets. Raises Finding for calls of another shape than `name(a, b)`."""
    if not isinstance(node.func, ast.Name):
        hint = did_you_mean("", FUNCTIONS)
        raise Finding(text.span(node.func), Code.FORBIDDEN_EXPRESSION, "only listed functions are called", hint)
    if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
        message = f"{node.func.id}() takes its arguments by position"
        raise Finding(text.span(node), Code.WRONG_ARGUMENTS, message)
    return node.func.id


def function_named(name: str, span: SourceSpan) -> Function:
    function = FUNCTIONS.get(name)
    if function is None:
        hint = did_you_mean(name, [*FUNCTIONS, HAS])
        raise Finding(span, Code.UNKNOWN_FUNCTION, f"there is no function '{name}'", hint)
    return function


def call_of(function: Function, arguments: Sequence[Typed], span: SourceSpan, expected: Type | None) -> Typed:
    """The call as a checked expression; bounds that it leaves out are those of the field `expected`."""
    if function.optional and len(arguments) == len(function.parameters) - function.optional:
        arguments = [*arguments, *_bounds(function, span, expected)]
    _want_count(function, len(arguments), span)
    _want_accepted(function, arguments)
    try:
        kind = function.result([argument.kind for argument in arguments])
    except ValueError as error:
        raise Finding(span, Code.WRONG_ARGUMENTS, f"{function.name}(): {error}") from None
    return Typed.at(span, kind, call(function.name, *[argument.node for argument in arguments]))


def _bounds(function: Function, span: SourceSpan, expected: Type | None) -> list[Typed]:
    if not isinstance(expected, Int):
        message = f"{function.name}() needs bounds here, where no integer field is filled"
        raise Finding(span, Code.WRONG_ARGUMENTS, message, f"write {function.name}(x, low, high)")
    return [Typed.at(span, IntKind(bound, bound), ast.Constant(bound)) for bound in (expected.low, expected.high)]


def _want_count(function: Function, count: int, span: SourceSpan) -> None:
    takes = len(function.parameters)
    if count < takes or (count > takes and not function.variadic):
        wanted = f"{takes} argument{'s' * (takes != 1)}" + " or more" * function.variadic
        message = f"{function.name}() takes {wanted}, not {count}"
        raise Finding(span, Code.WRONG_ARGUMENTS, message, f"write {function.signature}")


def _want_accepted(function: Function, arguments: Sequence[Typed]) -> None:
    repeated = [function.parameters[-1]] * (len(arguments) - len(function.parameters))
    for parameter, argument in zip([*function.parameters, *repeated], arguments, strict=True):
        if not isinstance(argument.kind, parameter.accepts):
            message = f"{function.name}() takes {parameter.wanted} as '{parameter.name}', not {argument.kind}"
            raise Finding(argument.span, Code.WRONG_ARGUMENTS, message)

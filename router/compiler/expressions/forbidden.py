"""How findings speak of Python that the language does not have."""

from __future__ import annotations

import ast

from router.compiler.expressions.typed import Finding
from router.errors import Code, SourceSpan

ALLOWED = "allowed: fields, literals, arithmetic, comparison, and/or/not, if/else, functions"


def forbidden(node: ast.AST, span: SourceSpan) -> Finding:
    """The finding for an expression, or an operator, that is not part of the language."""
    hint = _HINTS.get(type(node), ALLOWED if isinstance(node, ast.expr) else "")
    word = _WORDS.get(type(node), type(node).__name__)
    return Finding(span, Code.FORBIDDEN_EXPRESSION, f"{word} is not part of the language", hint)


_HINTS: dict[type[ast.AST], str] = {
    ast.Constant: "literals are numbers, strings, True and False",
    ast.Lambda: "expressions have no lambda",
    ast.ListComp: "expressions have no loops",
    ast.GeneratorExp: "expressions have no loops",
    ast.SetComp: "expressions have no loops",
    ast.DictComp: "expressions have no loops",
    ast.NamedExpr: "expressions assign nothing",
    ast.JoinedStr: "join strings with + and str()",
    ast.Tuple: "write a list, [a, b]",
    ast.Is: "use ==",
    ast.IsNot: "use ==",
}
_WORDS: dict[type[ast.AST], str] = {
    ast.Constant: "this literal", ast.JoinedStr: "an f-string", ast.NamedExpr: "':='", ast.ListComp: "a comprehension",
    ast.SetComp: "a comprehension", ast.DictComp: "a comprehension", ast.GeneratorExp: "a comprehension",
    ast.Tuple: "a tuple", ast.Dict: "a dictionary", ast.Set: "a set", ast.Lambda: "lambda", ast.Starred: "'*'",
    ast.BitAnd: "'&'", ast.BitOr: "'|'", ast.BitXor: "'^'", ast.LShift: "'<<'", ast.RShift: "'>>'", ast.Invert: "'~'",
    ast.MatMult: "'@'", ast.Is: "'is'", ast.IsNot: "'is not'", ast.Await: "await", ast.Yield: "yield",
    ast.Slice: "a slice",
}  # fmt: skip

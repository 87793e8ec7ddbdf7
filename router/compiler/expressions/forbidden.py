"""How findings speak of Python that the language does not have."""

from __future__ import annotations

import ast

from router.compiler.expressions.typed import Finding
from router.errors import Code, SourceSpan

ALLOWED = "allowed: fields, literals, arithmetic, comparison, and/or/not, if/else, functions"


def forbidden(node: ast.AST, span: SourceSpan) -> Finding:
    """The finding for an expression, or an operator, that is not part of the language."""
    hint = _HINTS.get(type(node), ALLOWED if isinstance(node, ast.expr) else "")
    word = _WORDS.get(type(node).__name__, type(node).__name__)
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
# By name: some of them do not exist in every Python that we support.
_WORDS = {
    "Constant": "this literal", "JoinedStr": "an f-string", "NamedExpr": "':='", "ListComp": "a comprehension",
    "SetComp": "a comprehension", "DictComp": "a comprehension", "GeneratorExp": "a comprehension",
    "Tuple": "a tuple", "Dict": "a dictionary", "Set": "a set", "Lambda": "lambda", "Starred": "'*'",
    "BitAnd": "'&'", "BitOr": "'|'", "BitXor": "'^'", "LShift": "'<<'", "RShift": "'>>'", "Invert": "'~'",
    "MatMult": "'@'", "Is": "'is'", "IsNot": "'is not'", "Await": "await", "Yield": "yield", "Slice": "a slice",
}  # fmt: skip

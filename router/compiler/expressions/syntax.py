"""Parses expressions to Python's syntax tree, with positions in the table.

Accepts anything that Python can parse; `forbidden` makes the finding for syntax that the language does not have.
"""

from __future__ import annotations

import ast
import io
import keyword
import re
import tokenize
import warnings
from collections.abc import Collection
from contextlib import suppress

from router.compiler.expressions import foreign_syntax
from router.compiler.expressions.scope import ExpressionError
from router.errors import Code, SourceSpan
from router.table.model.expressions import Expression


class Parsed:
    """A parsed expression with its syntax `tree`. Raises ExpressionError if it is not a Python expression.

    `names` are those of fields and variables, some of which may be Python keywords.
    """

    def __init__(self, expression: Expression, names: Collection[str] = ()) -> None:
        text = _with_words_as_names(expression.text.replace("\n", " "))
        self._names = names
        self._expression = expression
        self._indent = len(text) - len(text.lstrip())
        self._encoded = text.lstrip().encode(errors="replace")
        self.tree = self._parse(text.strip())

    def _parse(self, text: str) -> ast.expr:
        if "#" in text and (at := _comment(text)) is not None:
            span = self._expression.text_span.part(self._indent + at, self._indent + at + 1)
            message = "'#' ends the expression, and the rest is ignored"
            hint = "remove it: in quoted and in multi-line text, '#' does not start a YAML comment"
            raise ExpressionError(span, Code.EXPRESSION_SYNTAX, message, hint)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SyntaxWarning)
                warnings.simplefilter("ignore", DeprecationWarning)
                return _with_words(ast.parse(text, mode="eval").body)
        except SyntaxError as error:
            span, reason = self._blamed(error), (error.msg or "cannot be read").removesuffix(" (<unknown>, line 1)")
            hint = self._of_word(text) or foreign_syntax.of_syntax(self._expression.text)
            if slip := foreign_syntax.slip(text, self._names):
                span, reason = self._expression.text_span.part(*(self._indent + at for at in slip.span)), slip.what
                hint = slip.hint
            raise ExpressionError(span, Code.EXPRESSION_SYNTAX, f"not an expression: {reason}", hint) from None
        except (ValueError, RecursionError, MemoryError) as error:
            raise ExpressionError(
                self._expression.span, Code.EXPRESSION_SYNTAX, f"not an expression: {error}"
            ) from None

    def _of_word(self, text: str) -> str:
        """Return a hint if a field whose name is a keyword of expressions is used without `message.`."""
        words = {lexeme["name"] for lexeme in _LEXEMES.finditer(text) if lexeme["name"] and not lexeme["dot"]}
        named = sorted(_MEANINGFUL & words & {*self._names})
        return f"write message.{named[0]} for the field '{named[0]}'" if named else ""

    def _blamed(self, error: SyntaxError) -> SourceSpan:
        """Return the span of a syntax error, which counts from 1 and may have no position, or end on another line."""
        start = max(error.offset or 1, 1) - 1
        end = error.end_offset - 1 if error.end_offset and error.end_lineno == error.lineno else start + 1
        return self._expression.text_span.part(self._indent + start, self._indent + end)

    def span(self, node: ast.expr) -> SourceSpan:
        """Return the span of a node in the table."""
        end = node.end_col_offset if node.end_col_offset is not None else node.col_offset + 1
        return self._expression.text_span.part(self._characters(node.col_offset), self._characters(end))

    def last_span(self, node: ast.Attribute) -> SourceSpan:
        """Return the span of the last name of `a.b.c`."""
        end = self._characters(node.end_col_offset or 0)
        return self._expression.text_span.part(end - len(node.attr), end)

    def outermost(self, node: ast.Attribute) -> ast.Attribute:
        """Return the whole `a.b.c.d` that contains `a.b`."""
        holders = {
            id(attribute.value): attribute for attribute in ast.walk(self.tree) if isinstance(attribute, ast.Attribute)
        }
        while outer := holders.get(id(node)):
            node = outer
        return node

    def _characters(self, offset: int) -> int:
        """Convert an offset in UTF-8 bytes, as ast counts, to characters."""
        return self._indent + len(self._encoded[:offset].decode(errors="replace"))


_MEANINGFUL = frozenset(
    {"and", "or", "not", "in", "is", "if", "else", "True", "False", "None", "lambda", "for", "await", "yield"}
)
"""Keywords of Python that are names only after a dot."""

_LEXEMES = re.compile(
    r"""
    '(?:\\.|[^'\\])*' | "(?:\\.|[^"\\])*" |             # quoted
    \d[\d_]*(?:\.[\d_]*)?(?:[eE][-+]?\d+)?\w* |         # a number
    (?P<dot>\.\s*)? (?P<name>[^\W\d]\w*)
    """,
    re.VERBOSE,
)
_MARKED = 0xA000
"""Characters from here on (Yi syllables, letters for Python) replace and mark the first letter of a keyword."""


def _with_words_as_names(text: str) -> str:
    """Replace Python keywords that may be fields by names of the same length that Python parses."""

    def replaced(lexeme: re.Match[str]) -> str:
        dot, name = lexeme["dot"] or "", lexeme["name"]
        if not name or not keyword.iskeyword(name) or (name in _MEANINGFUL and not dot):
            return lexeme[0]
        return dot + chr(_MARKED + ord(name[0])) + name[1:]

    return _LEXEMES.sub(replaced, text)


def _with_words(tree: ast.expr) -> ast.expr:
    """Restore the keywords in the syntax tree."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            node.id = _word(node.id)
        elif isinstance(node, ast.Attribute):
            node.attr = _word(node.attr)
    return tree


def _word(name: str) -> str:
    is_marked = _MARKED <= ord(name[0]) < _MARKED + 128
    return chr(ord(name[0]) - _MARKED) + name[1:] if is_marked else name


def _comment(text: str) -> int | None:
    """Return the index at which a Python comment begins, outside of quotes; None if there is no comment."""
    with suppress(tokenize.TokenError, SyntaxError):
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                return token.start[1]
    return None


def dotted(node: ast.expr) -> tuple[str, ...] | None:
    """Return the parts of `a.b.c`, None for anything else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return (node.id, *reversed(parts)) if isinstance(node, ast.Name) else None


ALLOWED = "allowed: fields, literals, arithmetic, comparison, and/or/not, if/else, functions"


def forbidden(node: ast.AST, span: SourceSpan) -> ExpressionError:
    """Return the error for an expression, or an operator, that is not part of the language."""
    hint = _HINTS.get(type(node), ALLOWED if isinstance(node, ast.expr) else "")
    word = _WORDS.get(type(node), type(node).__name__)
    return ExpressionError(span, Code.FORBIDDEN_EXPRESSION, f"{word} is not part of the language", hint)


_WITHOUT_LOOP = "calculate with the whole list, as in x * 2, or with a field of each element, as in x.y * 2"
_HINTS: dict[type[ast.AST], str] = {
    ast.Constant: f"write a number, a string, True or False; {foreign_syntax.LEFT_OUT}",
    ast.BitXor: foreign_syntax.SQUARE,
    ast.LShift: foreign_syntax.SHIFT,
    ast.RShift: foreign_syntax.SHIFT,
    ast.BitAnd: foreign_syntax.BITS.format("and"),
    ast.BitOr: foreign_syntax.BITS.format("or"),
    ast.Invert: foreign_syntax.BITS.format("not"),
    ast.Lambda: "write its body alone",
    ast.Dict: "write a map of values without quotes: {map: FIELD, VALUE: ..., else: ...}",
    **dict.fromkeys((ast.ListComp, ast.GeneratorExp, ast.SetComp, ast.DictComp), _WITHOUT_LOOP),
    ast.NamedExpr: "write the value alone: expressions cannot assign",
    ast.JoinedStr: "join strings with +, str() and text()",
    ast.Tuple: "remove the ',', or write a list, [a, b]; write decimal numbers with a point, 9.81",
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

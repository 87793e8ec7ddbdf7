"""What the check of an expression ends in: a typed value, or the one finding that stops it."""

from __future__ import annotations

import ast
from dataclasses import dataclass

from router.compiler.kinds import Kind
from router.compiler.syntax import placed
from router.errors import Code, Diagnostic, SourceSpan


class Finding(Exception):
    """Ends the check of one expression with the first thing that is wrong in it."""

    def __init__(self, span: SourceSpan, code: Code, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.diagnostic = Diagnostic(span, code, message, hint)


@dataclass(frozen=True, slots=True)
class Typed:
    """A checked expression: what it is, as Python, and which stretch of the table says so.

    `items` are the elements of a list literal; `path` leads to a submessage of the source message.
    """

    kind: Kind
    node: ast.expr
    span: SourceSpan
    items: tuple[Typed, ...] | None = None
    path: tuple[str, ...] | None = None

    @classmethod
    def at(
        cls,
        span: SourceSpan,
        kind: Kind,
        node: ast.expr,
        *,
        items: tuple[Typed, ...] | None = None,
        path: tuple[str, ...] | None = None,
    ) -> Typed:
        """The same for syntax that was just made: what of it has no place yet is placed at `span`."""
        return cls(kind, placed(node, span), span, items, path)

    @property
    def constant(self) -> object:
        """The value of a literal, None for everything else (there is no None in the language)."""
        return self.node.value if isinstance(self.node, ast.Constant) else None

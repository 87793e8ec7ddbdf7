"""Python syntax of our making, and the place in the table that it stands for, which tracebacks will blame.

Knows neither the expression language nor what generated code does.
"""

from __future__ import annotations

import ast
import keyword

from router.errors import SourceSpan

PLACEABLE = (ast.expr, ast.stmt, ast.excepthandler, ast.arg)
"""The syntax nodes of generated code that have a position, for isinstance()."""


def place(node: ast.expr | ast.stmt | ast.excepthandler | ast.arg, span: SourceSpan) -> None:
    """Gives a syntax node the table's line and columns, these in characters (see `Source.compile`)."""
    node.lineno = node.end_lineno = span.line
    node.col_offset, node.end_col_offset = span.column - 1, span.end_column - 1


def placed(made: ast.expr, span: SourceSpan) -> ast.expr:
    """The same expression, its new nodes placed at `span`; nodes that have a place keep it."""
    for node in ast.walk(made):
        if isinstance(node, ast.expr) and not hasattr(node, "lineno"):
            place(node, span)
    return made


def load(variable: str) -> ast.Name:
    return ast.Name(variable, ast.Load())


def call(function: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(load(function), list(arguments), [])


def attribute(holder: ast.expr, member: str) -> ast.expr:
    """`holder.member`, also where the protobuf field has the name of a Python keyword."""
    if keyword.iskeyword(member):
        return call("getattr", holder, ast.Constant(member))
    return ast.Attribute(holder, member, ast.Load())

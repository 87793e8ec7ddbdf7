"""Generated Python: text for people and a syntax tree for the interpreter, made from the same lines.

Every line has its span in the route table, and grafted expressions keep their own, so that a traceback points into
the YAML file. Values enter by namespace, never by pasting.
"""

from __future__ import annotations

import ast
import copy
import keyword
import linecache
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import CodeType

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


INDENT = "    "
_PLACEHOLDER = re.compile(r"_expression_(\d+)_")


class _NamedConstants(ast.NodeTransformer):
    """Write `nan` and `inf` by name, for which Python has no literals."""

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return ast.Name(str(node.value)) if _is_named(node) else node


def _is_named(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, float) and not math.isfinite(node.value)


class Source:
    """One function in the making."""

    def __init__(self) -> None:
        self.constants: dict[str, object] = {}
        self._lines: list[tuple[str, SourceSpan]] = []
        self._expressions: list[ast.expr] = []
        self._depth = 0

    def line(self, text: str, span: SourceSpan) -> None:
        """Appends one line; `text` may hold what `expression` returned, and a comment."""
        self._lines.append((INDENT * self._depth + text, span))

    @contextmanager
    def block(self, text: str, span: SourceSpan) -> Iterator[None]:
        """Appends a line that ends in a colon, and indents what is appended inside."""
        self.line(text, span)
        with self.indented():
            yield

    @contextmanager
    def indented(self) -> Iterator[None]:
        self._depth += 1
        yield
        self._depth -= 1

    def expression(self, node: ast.expr) -> str:
        """A stand-in for a syntax tree, to be put into a line."""
        self._expressions.append(node)
        return f"_expression_{len(self._expressions) - 1}_"

    def constant(self, name: str, value: object) -> str:
        """A name for a value in the function's namespace: `name`, or `name_2` when that is taken."""
        unique, number = name, 1
        while unique in self.constants:
            number += 1
            unique = f"{name}_{number}"
        self.constants[unique] = value
        return unique

    def text(self) -> str:
        """What `router explain` prints."""
        return "\n".join(self._shown(line) for line, _ in self._lines) + "\n"

    def _shown(self, line: str) -> str:
        alone = _PLACEHOLDER.fullmatch(line.strip().rstrip(",")) is not None

        def replaced(found: re.Match[str]) -> str:
            node = self._expressions[int(found[1])]
            if any(map(_is_named, ast.walk(node))):
                node = _NamedConstants().visit(copy.deepcopy(node))
            text = ast.unparse(node)
            return text if alone or isinstance(node, (ast.Constant, ast.Name, ast.Attribute, ast.Call)) else f"({text})"

        return _PLACEHOLDER.sub(replaced, line)

    def tree(self) -> ast.Module:
        """The same as a syntax tree with the table's positions."""
        module = ast.parse("\n".join(line for line, _ in self._lines))
        for node in ast.walk(module):
            if isinstance(node, PLACEABLE):
                place(node, self._lines[node.lineno - 1][1])
        grafted: ast.Module = _Graft(self._expressions).visit(module)
        return grafted

    def compile(self, file: str) -> CodeType:
        """Code whose tracebacks name `file` and have their carets under what is blamed in it."""
        tree = self.tree()
        linecache.checkcache(file)
        _count_bytes(tree, linecache.getlines(file))
        return compile(tree, file, "exec", dont_inherit=True, optimize=0)


def _count_bytes(tree: ast.Module, lines: Sequence[str]) -> None:
    """Turns columns from characters into UTF-8 bytes, which is what they are for Python when it sets carets.

    `lines` are from where a traceback will have them; a line that cannot be shown will have no carets.
    """
    for node in ast.walk(tree):
        if isinstance(node, PLACEABLE) and node.lineno <= len(lines):
            line = lines[node.lineno - 1]
            if not line.isascii():
                node.col_offset = len(line[: node.col_offset].encode())
                node.end_col_offset = len(line[: node.end_col_offset].encode())


class _Graft(ast.NodeTransformer):
    def __init__(self, expressions: list[ast.expr]) -> None:
        self.expressions = expressions

    def visit_Name(self, node: ast.Name) -> ast.expr:
        found = _PLACEHOLDER.fullmatch(node.id)
        return copy.deepcopy(self.expressions[int(found[1])]) if found else node


def namespace_name(text: str) -> str:
    """A topic's or endpoint's name as part of a Python name: `imu/data_raw` is `imu_data_raw`."""
    return re.sub(r"\W", "_", text).strip("_")

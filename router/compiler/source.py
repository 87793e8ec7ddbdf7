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
    """Set the position of a syntax node to a line and columns of the table, in characters (see `Source.compile`)."""
    node.lineno = node.end_lineno = span.line
    node.col_offset, node.end_col_offset = span.column - 1, span.end_column - 1


def placed(made: ast.expr, span: SourceSpan) -> ast.expr:
    """Set the position of nodes that have none to `span`, and return the expression."""
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
    """The source of one function, line by line."""

    def __init__(self) -> None:
        self.constants: dict[str, object] = {}
        self._lines: list[tuple[str, SourceSpan]] = []
        self._expressions: list[ast.expr] = []
        self._depth = 0

    def line(self, text: str, span: SourceSpan) -> None:
        """Append one line; `text` may contain what `expression` returned, and a comment."""
        self._lines.append((INDENT * self._depth + text, span))

    @contextmanager
    def block(self, text: str, span: SourceSpan) -> Iterator[None]:
        """Append a line that ends in a colon, and indent what is appended inside."""
        self.line(text, span)
        with self.indented():
            yield

    @contextmanager
    def indented(self) -> Iterator[None]:
        self._depth += 1
        yield
        self._depth -= 1

    def expression(self, node: ast.expr) -> str:
        """Return a placeholder for a syntax tree, to be put into a line."""
        self._expressions.append(node)
        return f"_expression_{len(self._expressions) - 1}_"

    def constant(self, name: str, value: object) -> str:
        """Add a value to the function's namespace, and return its name: `name`, or `name_2` if that is taken."""
        unique, number = name, 1
        while unique in self.constants:
            number += 1
            unique = f"{name}_{number}"
        self.constants[unique] = value
        return unique

    def text(self) -> str:
        """The source as text, which `router explain` prints."""
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
        """The source as a syntax tree with the positions of the table."""
        module = ast.parse("\n".join(line for line, _ in self._lines))
        for node in ast.walk(module):
            if isinstance(node, PLACEABLE):
                place(node, self._lines[node.lineno - 1][1])
        grafted: ast.Module = _Graft(self._expressions).visit(module)
        return grafted

    def compile(self, file: str) -> CodeType:
        """Compile it. Tracebacks name `file`, with carets under the part of the table that is at fault."""
        tree = self.tree()
        linecache.checkcache(file)
        _count_bytes(tree, linecache.getlines(file))
        return compile(tree, file, "exec", dont_inherit=True, optimize=0)


def _count_bytes(tree: ast.Module, lines: Sequence[str]) -> None:
    """Turn columns from characters into UTF-8 bytes, which Python expects for carets.

    `lines` are those that a traceback will show; a line that cannot be shown has no carets.
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

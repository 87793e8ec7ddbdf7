"""A comment that looks like the rest of an expression: `x # 1000`, where `#` is no operator."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from router.errors import Code, Diagnostic
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.table.source import Source

_EXPRESSIONS = ("fields", "send", "when")
"""Keys of routes below which expressions stand."""
_REST = re.compile(r"\s+#\s*(?:[-+*/%<>]\s*\w[\w.]*|\d+(?:\.\d*)?(?:e-?\d+)?)\s*")


def cut_findings(root: MappingNode, sources: Sequence[Source]) -> Iterator[Diagnostic]:
    """A warning for each expression of the routes before a comment that is only a number, or an operator and a word."""
    lines = {source.file: source.lines for source in sources}
    for node in _expressions(root.get("routes"), is_expression=False):
        span = node.span
        comment = lines[span.file][span.line - 1][span.end_column - 1 :] if node.place.is_whole_line else ""
        if _REST.fullmatch(comment):
            what = f"the comment '{comment.strip()}' is no part of the expression before it"
            hint = "write an operator in place of '#', or say in the comment what it is about"
            yield Diagnostic(span, Code.CUT_EXPRESSION, what, hint)


def _expressions(node: Node | None, *, is_expression: bool) -> Iterator[ScalarNode]:
    if isinstance(node, ScalarNode):
        if is_expression:
            yield node
    elif isinstance(node, SequenceNode):
        for item in node.items:
            yield from _expressions(item, is_expression=is_expression)
    elif isinstance(node, MappingNode):
        for key, entry in node.entries.items():
            yield from _expressions(entry.value, is_expression=is_expression or key in _EXPRESSIONS)

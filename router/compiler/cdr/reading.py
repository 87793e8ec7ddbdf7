"""ROS messages as expressions see them: code that reads the wanted fields, and only those, out of CDR bytes `cdr`."""

from __future__ import annotations

import ast

from router.compiler.cdr.reading_code import ReadingCode
from router.compiler.cdr.reading_steps import decoder, steps
from router.compiler.expressions.reads import Path, Reads
from router.compiler.source import Source
from router.compiler.syntax import call, load
from router.errors import SourceSpan
from router.types.model import Field, MessageType


class CdrReads(Reads):
    """A serialized ROS message. What is read: every field that was asked for, up to the last of them.

    The code raises MappingError or struct.error when the bytes are no such message. Strings are decoded where they
    are used: a bad one concerns only who uses it.
    """

    def __init__(self, message: MessageType) -> None:
        super().__init__()
        self._message = message
        self._wanted: dict[Path, None] = {}

    def field(self, holder: Path, member: Field) -> ast.expr:
        path = (*holder, member.name)
        self._wanted[path] = None
        variable, decode = load(self._variable(path)), decoder(member.type)
        return call(decode, variable) if decode else variable

    def message(self, path: Path) -> ast.expr:
        return load(self._variable(path))

    def need_objects(self, node: ast.expr) -> None:
        paths = {variable: path for path, variable in self.variables.items()}
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name) and inner.id in paths:
                self._wanted[paths[inner.id]] = None

    def write(self, out: Source, span: SourceSpan) -> None:
        with out.block("if cdr[:2] != CDR_LE:", span):
            out.line("refuse(cdr[:2])", span)
        code = ReadingCode(out, span)
        code.write(steps(self._message, self._wanted, self._variable))
        if not code.is_checked:
            with out.block("if at > len(cdr):", span):
                out.line("cut_off(cdr)", span)

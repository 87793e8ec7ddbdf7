"""Where the expressions of a target find the source message: the variables that its code makes before it uses them.

Knows variables; not what the expressions do with them.
"""

from __future__ import annotations

import ast
from abc import ABC, abstractmethod

from router.compiler.source import Source
from router.compiler.syntax import attribute, call, load, placed
from router.errors import SourceSpan
from router.types.model import Field, List, MessageType

Path = tuple[str, ...]
"""The names that lead from the source message to a field of it; the empty path is the message."""


def value_of(message: ast.expr, member: Field) -> ast.expr:
    """A field of a message that is there as an object. A protobuf map is read as the list of its entries."""
    value = attribute(message, member.name)
    element = member.type.element if isinstance(member.type, List) else None
    return call("entries", value) if isinstance(element, MessageType) and element.is_map_entry else value


class Reads(ABC):
    """The source message as the expressions of one or several targets see it. Remembers what they ask for."""

    def __init__(self) -> None:
        self.variables: dict[Path, str] = {(): "m"}
        self._loops = 0

    @abstractmethod
    def field(self, holder: Path, member: Field) -> ast.expr:
        """The value of a field, not a message, of the submessage at path `holder`."""

    @abstractmethod
    def message(self, path: Path) -> ast.expr:
        """The submessage at a path."""

    @abstractmethod
    def need_objects(self, node: ast.expr) -> None:
        """Told of each expression that is more than a path: a message in it must be there as an object."""

    @abstractmethod
    def write(self, out: Source, span: SourceSpan) -> None:
        """Appends the statements that make what the expressions use; to be called when all of them are checked."""

    def loop(self) -> str:
        """A variable for the elements of a list, another one each time."""
        self._loops += 1
        return f"item_{self._loops}"

    def _variable(self, path: Path) -> str:
        """The variable for what is at a path, the same each time."""
        if path not in self.variables:
            variable = "_".join((self.variables[()], *path))
            while variable in self.variables.values():  # a.b_c and a_b.c
                variable += "_"
            self.variables[path] = variable
        return self.variables[path]


class ParsedReads(Reads):
    """A parsed protobuf message `m`: each submessage that expressions look into is bound once."""

    def field(self, holder: Path, member: Field) -> ast.expr:
        return value_of(self.message(holder), member)

    def message(self, path: Path) -> ast.expr:
        if path:
            self.message(path[:-1])  # a submessage's own holder comes before it
        return load(self._variable(path))

    def need_objects(self, node: ast.expr) -> None:
        """They always are."""

    def write(self, out: Source, span: SourceSpan) -> None:
        for path, variable in self.variables.items():
            if path:
                made = placed(attribute(load(self.variables[path[:-1]]), path[-1]), span)
                out.line(f"{variable} = {out.expression(made)}", span)

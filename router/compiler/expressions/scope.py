"""What the names of an expression mean, and what the check of an expression gives: a typed value or an error.

`Scope` has the type of the source message and the constants in sight, `Reads` the variables through which generated
code accesses the message.
"""

from __future__ import annotations

import ast
import copy
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from router.compiler.expressions.kinds import Kind, MessageKind, kind_of
from router.compiler.source import Source, attribute, call, load, place, placed
from router.errors import Code, Diagnostic, SourceSpan
from router.types.model import Enum, Field, List, MessageType


class ExpressionError(Exception):
    """Ends the check of one expression with the first thing that is wrong in it."""

    def __init__(self, span: SourceSpan, code: Code, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.diagnostic = Diagnostic(span, code, message, hint)


@dataclass(frozen=True, slots=True)
class Typed:
    """A checked expression: its kind, its Python syntax, and its position in the table.

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
        """Make it of new syntax, whose nodes without a position get `span`."""
        return cls(kind, placed(node, span), span, items, path)

    @property
    def constant(self) -> object:
        """The value of a literal, None for everything else (there is no None in the language)."""
        return self.node.value if isinstance(self.node, ast.Constant) else None


Path = tuple[str, ...]
"""The names that lead from the source message to a field of it; the empty path is the message."""


def value_of(message: ast.expr, member: Field) -> ast.expr:
    """A field of a message object. A protobuf map is read as the list of its entries."""
    value = attribute(message, member.name)
    element = member.type.element if isinstance(member.type, List) else None
    if member.is_unchecked:
        return call("checked_texts" if element else "checked_text", value)
    return call("entries", value) if isinstance(element, MessageType) and element.is_map_entry else value


class Reads(ABC):
    """Variables for the source message in the expressions of one or several targets. Collects what they use."""

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
        """Called for each expression that is more than a path: messages in it have to be objects."""

    @abstractmethod
    def write(self, out: Source, span: SourceSpan) -> None:
        """Append the statements that make the variables, once all expressions are checked."""

    def loop(self) -> str:
        """A new variable for the elements of a list."""
        self._loops += 1
        return f"item_{self._loops}"

    def _variable(self, path: Path) -> str:
        """The variable for a path, the same each time."""
        if path not in self.variables:
            variable = "_".join((self.variables[()], *path))
            while variable in self.variables.values():  # a.b_c and a_b.c
                variable += "_"
            self.variables[path] = variable
        return self.variables[path]


class ParsedReads(Reads):
    """Reads of a parsed protobuf message `m`: each submessage that expressions use is bound once."""

    def field(self, holder: Path, member: Field) -> ast.expr:
        return value_of(self.message(holder), member)

    def message(self, path: Path) -> ast.expr:
        if path:
            self.message(path[:-1])  # a submessage's own holder comes before it
        return load(self._variable(path))

    def need_objects(self, node: ast.expr) -> None:
        """Messages in a parsed message are always objects."""

    def write(self, out: Source, span: SourceSpan) -> None:
        for path, variable in self.variables.items():
            if path:
                made = placed(attribute(load(self.variables[path[:-1]]), path[-1]), span)
                out.line(f"{variable} = {out.expression(made)}", span)


MESSAGE, SOURCE, RECEIVED_AT = "message", "source", "received_at"
"""What every expression can name beside the fields; a field of the same name wins."""


@dataclass(slots=True)
class Scope:
    """What names mean in the expressions of one target.

    `enums` are the protobuf enums by full name, `ros_types` the ROS types whose constants are visible. `names` are
    variables beside the message's fields; they win over fields of the same name. `given` are those of
    MESSAGE, SOURCE and RECEIVED_AT that can be named. `sources` are the values that SOURCE can have, empty if they are
    not known.
    """

    message: MessageType
    enums: Collection[Enum]
    ros_types: Collection[MessageType]
    reads: Reads
    names: Mapping[str, Typed] = field(default_factory=dict)
    given: Collection[str] = (MESSAGE, SOURCE, RECEIVED_AT)
    sources: Collection[str] = ()

    def field_names(self) -> list[str]:
        """The fields of the message and the names beside them."""
        return [*self.names, *(member.name for member in self.message.fields)]

    def variable(self, name: str, span: SourceSpan) -> Typed:
        """One of `names`, positioned at `span`."""
        given = self.names[name]
        node = copy.deepcopy(given.node)
        for inner in ast.walk(node):
            if isinstance(inner, ast.expr):
                place(inner, span)
        return replace(given, node=node, span=span)

    def holder_names(self) -> set[str]:
        """The names of everything that has constants: enums by full and short name, ROS types by short name."""
        enums = {known for enum in self.enums for known in (enum.name, enum.name.rpartition(".")[2])}
        return enums | {ros.short_name for ros in self.ros_types if ros.constants}

    def holders(self, text: str) -> list[Enum | MessageType]:
        """The enums, else ROS types, that `text` may mean; an enum of the message itself comes first."""
        named = [enum for enum in self.enums if enum.name == text or enum.name.endswith(f".{text}")]
        own = [enum for enum in named if enum.name == f"{self.message.name}.{text}"]
        exact = [enum for enum in named if enum.name == text]
        return list(own or exact or named) + [ros for ros in self.ros_types if ros.short_name == text]

    def whole_message(self, span: SourceSpan) -> Typed:
        return Typed.at(span, MessageKind(self.message), self.reads.message(()), path=())

    def field_of(self, holder: Typed, member: Field, span: SourceSpan) -> Typed:
        """A field of the message that `holder` is; through a local variable if a path leads to it."""
        if holder.path is None:
            return Typed.at(span, kind_of(member.type), value_of(holder.node, member))
        return self.read(holder.path, member, span)

    def read(self, holder: Path, member: Field, span: SourceSpan) -> Typed:
        """A field of the submessage of the source message at path `holder`."""
        kind = kind_of(member.type)
        if isinstance(kind, MessageKind):
            path = (*holder, member.name)
            return Typed.at(span, kind, self.reads.message(path), path=path)
        return Typed.at(span, kind, self.reads.field(holder, member))

"""Names that are visible in an expression: fields of the source message, variables and constants."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import count

from router.compiler.expressions.kinds import Kind, MessageKind, kind_of
from router.compiler.expressions.tree import ENVELOPE, ITEM, MESSAGE, RECEIVED_AT, SOURCE, Node, Read, Variable
from router.errors import Code, FindingError, SourceSpan
from router.types.model import Enum, Field, List, MessageType, String
from router.types.protobuf import Envelope


class ExpressionError(FindingError):
    """The first mistake in an expression."""


class BrokenStateError(ExpressionError):
    """An expression reads a state whose declaration has a finding already."""


@dataclass(slots=True)
class Scope:
    """The names in the expressions of one target.

    `enums` are the protobuf enums by full name, `ros_types` the ROS types whose constants are visible. `names` are
    additional variables, which take precedence over fields. `given` are those of MESSAGE, SOURCE and RECEIVED_AT that
    are available. `envelope` is that of a message from UDP, which ENVELOPE then names. `sources` are the possible
    values of SOURCE, empty if they are not known. `states` are the kinds of the table's states, None for one with a
    finding; only conditions can read them (`reads_states`). `absent` are names that a missing key of the route would
    define, each with message and hint. `element` is the message in a list whose fields are visible instead of those of
    the source message; `message` is then its type, and `source` the type of the source message.
    """

    message: MessageType
    enums: Collection[Enum]
    ros_types: Collection[MessageType]
    names: Mapping[str, Node] = field(default_factory=dict)
    given: Collection[str] = (MESSAGE, SOURCE, RECEIVED_AT)
    envelope: Envelope | None = None
    sources: Collection[str] = ()
    states: Mapping[str, Kind | None] = field(default_factory=dict)
    reads_states: bool = False
    absent: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    element: Node | None = None
    source: MessageType | None = None
    _elements: Iterator[int] = field(default_factory=lambda: count(1))

    def element_variable(self) -> str:
        """Return a new variable for the elements of a list."""
        return f"item_{next(self._elements)}"

    def field_names(self) -> list[str]:
        """Return the fields of the message and the additional variables."""
        return [*self.names, *self.message.names]

    def variable(self, name: str, span: SourceSpan) -> Node:
        """Return one of `names`, positioned at `span`."""
        return replace(self.names[name], span=span)

    def holder_names(self) -> set[str]:
        """Return the names of all types with constants: enums by full and short name, ROS types by short name."""
        enums = {known for enum in self.enums for known in (enum.name, enum.name.rpartition(".")[2])}
        return enums | {ros.short_name for ros in self.ros_types if ros.constants}

    def holders(self, text: str) -> list[Enum | MessageType]:
        """Return the enums and ROS types that `text` may mean; an enum of the message itself comes first."""
        named = [enum for enum in self.enums if enum.name == text or enum.name.endswith(f".{text}")]
        own = [enum for enum in named if enum.name == f"{self.message.name}.{text}"]
        exact = [enum for enum in named if enum.name == text]
        return list(own or exact or named) + [ros for ros in self.ros_types if ros.short_name == text]

    def messages(self) -> list[tuple[str, MessageType]]:
        """Return the messages whose fields can be read, each with the prefix of a field's name."""
        kinds = [(f"{name}.", node.kind) for name, node in self.names.items()]
        beside = [(f"{ENVELOPE}.", self.envelope.beside)] if self.envelope is not None else []
        variables = [(prefix, kind.type) for prefix, kind in kinds if isinstance(kind, MessageKind)]
        if self.source is not None:
            variables = [(f"{MESSAGE}.", self.source), *(found for found in variables if found[0] != f"{ITEM}.")]
        return [("", self.message), *variables, *beside]

    def whole_message(self, span: SourceSpan) -> Node:
        """Return the message whose fields are visible."""
        return self.source_message(span) if self.element is None else replace(self.element, span=span)

    def source_message(self, span: SourceSpan) -> Variable:
        return Variable(MessageKind(self.source or self.message), span, MESSAGE)

    def of_element(self, element: Node) -> Scope:
        """Return the scope of expressions over `element`, a message in a list. Its fields hide variables around it."""
        assert isinstance(element.kind, MessageKind)  # noqa: S101 - the caller ensures it
        message = element.kind.type
        names = {name: node for name, node in self.names.items() if message.field(name) is None} | {ITEM: element}
        return replace(self, message=message, names=names, element=element, source=self.source or self.message)

    def whole_envelope(self, span: SourceSpan) -> Variable | None:
        """Return the fields beside the payload; None for a message that is not from UDP."""
        return Variable(MessageKind(self.envelope.beside), span, ENVELOPE) if self.envelope is not None else None


def field_of(holder: Node, member: Field, span: SourceSpan) -> Read:
    """Return a field of the message `holder`."""
    return Read(kind_of(member.type), span, holder, member)


def require_readable(node: Node) -> None:
    """Raise ExpressionError if expressions cannot read the field, or a field around it."""
    if not isinstance(node, Read):
        return
    require_readable(node.holder)
    what = _unreadable(node.field)
    if what is not None:
        kind, hint = what
        message = f"'{node.field.name}' is a {kind}, which expressions cannot read"
        raise ExpressionError(node.span, Code.FORBIDDEN_EXPRESSION, message, hint)


def _unreadable(member: Field) -> tuple[str, str] | None:
    """Return the kind of a field that expressions cannot read, and a hint; None for all others."""
    declared = member.type.element if isinstance(member.type, List) else member.type
    if isinstance(declared, MessageType) and declared.is_map_entry:
        return "map", "destinations get the map unchanged; for a topic, declare a list of messages with key and value"
    if member.is_group:
        return "group", "destinations get the group unchanged; for a topic, declare a message instead"
    if isinstance(declared, String) and declared.wide:
        return "wstring", "declare it as a string"
    return None

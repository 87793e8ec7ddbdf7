"""What names mean in the expressions of one target.

Knows the source message's type and the constants in sight; not the syntax that names stand in.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from router.compiler.expressions.reads import Path, Reads, value_of
from router.compiler.expressions.typed import Typed
from router.compiler.kinds import MessageKind, kind_of
from router.compiler.syntax import place
from router.errors import SourceSpan
from router.types.model import Enum, Field, MessageType

MESSAGE, SOURCE, RECEIVED_AT = "message", "source", "received_at"
"""What every expression can name beside the fields; a field of the same name wins."""


@dataclass(slots=True)
class Scope:
    """What names mean in the expressions of one target.

    `enums` are the protobuf enums by full name, `ros_types` the ROS types whose constants are visible. `names` are
    variables beside the message's fields; they win over fields of the same name. `given` is what can be named of
    MESSAGE, SOURCE and RECEIVED_AT: nothing where no message is.
    """

    message: MessageType
    enums: Collection[Enum]
    ros_types: Collection[MessageType]
    reads: Reads
    names: Mapping[str, Typed] = field(default_factory=dict)
    given: Collection[str] = (MESSAGE, SOURCE, RECEIVED_AT)

    def field_names(self) -> list[str]:
        """All that a name which stands alone can mean of the message and beside it."""
        return [*self.names, *(member.name for member in self.message.fields)]

    def variable(self, name: str, span: SourceSpan) -> Typed:
        """One of `names`, as it is used at `span`."""
        given = self.names[name]
        node = copy.deepcopy(given.node)
        for inner in ast.walk(node):
            if isinstance(inner, ast.expr):
                place(inner, span)
        return replace(given, node=node, span=span)

    def holder_names(self) -> set[str]:
        """Everything that constants can be asked of: enums by full and short name, ROS types by short name."""
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
        """A field of a message that an expression gave; through a local variable where a path leads to it."""
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

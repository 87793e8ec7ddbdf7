"""What names mean in the expressions of one target, and the local variables that its code keeps for them.

Knows the source message's type and the constants in sight; not the syntax that names stand in.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from router.compiler.expressions.typed import Typed
from router.compiler.kinds import MessageKind, kind_of
from router.compiler.syntax import attribute, load
from router.errors import SourceSpan
from router.types.model import Enum, Field, MessageType

MESSAGE, SOURCE, RECEIVED_AT = "message", "source", "received_at"
"""What every expression can name beside the fields; a field of the same name wins."""


@dataclass(slots=True)
class Locals:
    """The local variables of one target: submessages that its expressions look into, each bound once, and loops'."""

    message: str = "m"
    bound: dict[tuple[str, ...], str] = field(default_factory=dict)
    loops: int = 0

    def name(self, path: tuple[str, ...]) -> str:
        """The variable that holds the submessage at this path; the empty path is the message."""
        if not path:
            return self.message
        if path not in self.bound:
            self.name(path[:-1])  # a submessage's own holder comes before it
            variable = "_".join((self.message, *path))
            while variable in self.bound.values():  # a.b_c and a_b.c
                variable += "_"
            self.bound[path] = variable
        return self.bound[path]

    def loop(self) -> str:
        """A variable for the elements of a list, another one each time."""
        self.loops += 1
        return f"item_{self.loops}"


@dataclass(slots=True)
class Scope:
    """What names mean in the expressions of one target.

    `enums` are the protobuf enums by full name, `ros_types` the ROS types whose constants are visible.
    """

    message: MessageType
    enums: Collection[Enum]
    ros_types: Collection[MessageType]
    locals: Locals

    def field_names(self) -> list[str]:
        return [member.name for member in self.message.fields]

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
        return Typed.at(span, MessageKind(self.message), load(self.locals.message), path=())

    def field_of(self, holder: Typed, member: Field, span: SourceSpan) -> Typed:
        """A field of a message that an expression gave; through a local variable where a path leads to it."""
        if holder.path is None:
            return Typed.at(span, kind_of(member.type), attribute(holder.node, member.name))
        return self.read(holder.path, member, span)

    def read(self, holder: tuple[str, ...], member: Field, span: SourceSpan) -> Typed:
        """A field of the submessage of the source message at path `holder`."""
        kind = kind_of(member.type)
        if isinstance(kind, MessageKind):
            path = (*holder, member.name)
            return Typed.at(span, kind, load(self.locals.name(path)), path=path)
        return Typed.at(span, kind, attribute(load(self.locals.name(holder)), member.name))

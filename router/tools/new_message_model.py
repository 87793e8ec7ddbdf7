"""A new message as data, and what there is already: table, payload cases, folders. Decides nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from router.compiler import Checked
from router.errors import UsageError
from router.table.model import EnvelopeSettings, RouteTable
from router.types.protobuf import Envelope, ProtoSchema, load_protos

SCALARS = {
    "bool": "bool", "float": "float32", "double": "float64", "int32": "int32", "int64": "int64", "uint32": "uint32",
    "uint64": "uint64",
}  # fmt: skip
"""What a field can be beside an enum or a message: protobuf's spelling, and ROS's. Boards take all of these."""


@dataclass(frozen=True, slots=True)
class NewField:
    """`type` is one of SCALARS, or the full name of an enum or a message of the protos."""

    name: str
    type: str
    comment: str = ""


@dataclass(frozen=True, slots=True)
class NewMessage:
    """`board` is the endpoint that sends it, `case` its payload case, `fields` in the order of their numbers."""

    name: str
    number: int
    board: str
    case: str
    fields: tuple[NewField, ...]

    @property
    def prefix(self) -> str:
        """What the names of the board's messages begin with."""
        return prefix_of(self.board)

    @property
    def board_words(self) -> str:
        return self.board.replace("_", " ")

    @property
    def title(self) -> str:
        return f"{self.case.replace('_', ' ').capitalize()} from the {self.board_words}"

    @property
    def stem(self) -> str:
        """What its file is called: that a message is information need not be said there."""
        return self.case.removesuffix("_info")


@dataclass(frozen=True, slots=True)
class Site:
    """What there is: a table without errors, what it refers to, and the folder of our ROS messages."""

    table: RouteTable
    settings: EnvelopeSettings
    schema: ProtoSchema
    envelope: Envelope
    messages: Path

    def file(self, name: str) -> str:
        """The `.proto` file of a message or an enum, relative to the folder of the protos."""
        return self.schema.sources.file(name)

    def new_file(self, message: NewMessage) -> str:
        """Where its `.proto` file goes: the folder of its board, beside that of the envelope."""
        common = PurePosixPath(self.file(self.envelope.name)).parent
        return (common.parent / message.board / f"{message.stem}.proto").as_posix()


def site_of(checked: Checked, messages: Path) -> Site:
    """`checked` is a table without errors. Raises UsageError where it has no envelope."""
    if checked.table is None or checked.envelope is None:
        raise ValueError(f"{checked.path} has errors")
    settings = checked.table.envelope
    if settings is None:
        raise UsageError(f"{checked.path} has no 'envelope' that a message could be added to")
    schema = load_protos(settings, with_others=True)  # a field's type may be in a file of its own
    return Site(checked.table, settings, schema, checked.envelope, messages)


def prefix_of(board: str) -> str:
    return "".join(word.capitalize() for word in board.split("_"))

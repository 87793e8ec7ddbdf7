"""How an envelope says which messages a frame holds: a class for each `enum case_by` of the carrier.

A frame is a datagram with its trailing zeros restored. The fields of the classes are keys of a table's `envelope`.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, ClassVar, Union

from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.declared import ONLY_CASE
from router.types.lock_file import BY_ONEOF
from router.types.wire import I32, I32_SIZE, I64, I64_SIZE, LEN, VARINT, read_varint, varint

if TYPE_CHECKING:
    from router.types.protobuf import Envelope, PayloadCase


@dataclass(frozen=True, slots=True)
class Wrapping:
    """How an envelope holds a payload: in the field with this tag; with 0 the frame is the payload."""

    tag: int

    def size(self, payload: int) -> int:
        """Return the size in bytes of a frame with only a payload of `payload` bytes."""
        return len(varint(self.tag)) + len(varint(payload)) + payload if self.tag else payload


@dataclass(frozen=True, slots=True)
class ByOneof:
    """Each member of a oneof is a case."""

    oneof: str
    by: ClassVar[str] = BY_ONEOF
    """The kind of choice in the lock file: its name in `enum case_by`."""
    root: ClassVar[str] = ""
    """The case that the envelope itself is, "" if it only holds them."""

    def place(self, envelope: str, case: PayloadCase) -> str:
        """Describe where an envelope, by name, holds a payload."""
        return f"field {case.number} of {envelope}"

    def members_of(self, frame: Message) -> Sequence[str]:
        """Return the names of the cases that a parsed frame holds, even of those that no route can take."""
        name = frame.WhichOneof(self.oneof)
        return [str(name)] if name is not None else []

    def payload(self, frame: Message, case: str) -> Message:
        """Return a case that a parsed frame holds."""
        inner: Message = getattr(frame, case)
        return inner

    def put(self, frame: Message, case: str, payload: Message) -> None:
        """Make this payload, even an empty one, a parsed frame's."""
        inner = getattr(frame, case)
        inner.SetInParent()
        inner.CopyFrom(payload)

    def all_members(self, envelope: Envelope, frame: bytes) -> Sequence[str]:
        """Return the cases in a frame in order, also those that later ones supersede; consecutive pieces are one."""
        names = {(case.number, LEN): case.name for case in envelope.cases.values()}
        names |= {(member.number, member.wire_type): name for name, member in envelope.unroutable.items()}
        fields = UnknownFieldSet(Empty.FromString(frame))
        found = [(fields[index].field_number, fields[index].wire_type) for index in range(len(fields))]
        return [name for name, _ in groupby(names[member] for member in found if member in names)]

    def first_number(self, datagram: bytes, numbers: Container[int]) -> int:
        """Return the first of the cases with these `numbers` in a datagram, 0 if there is none.

        It is found without parsing the datagram, which may be malformed, trimmed or padded.
        """
        position = 0
        try:
            while position < len(datagram):
                tag, position = read_varint(datagram, position)
                if tag >> 3 in numbers:
                    return tag >> 3
                position = _after(datagram, position, tag & 7)
        except IndexError:
            pass  # it ends early: zeros were trimmed, or it is malformed
        return 0


def _after(data: bytes, position: int, wire_type: int) -> int:
    """Return the position after a value; for a group, the end. Raises IndexError."""
    if wire_type == VARINT:
        return read_varint(data, position)[1]
    if wire_type == LEN:
        size, position = read_varint(data, position)
        return position + size
    return position + {I64: I64_SIZE, I32: I32_SIZE}.get(wire_type, len(data))


@dataclass(frozen=True, slots=True)
class ByFrame:
    """The frame is the message of the only case, which the table names."""

    case: str
    by: ClassVar[str] = "frame"
    oneof: ClassVar[str] = ""

    @property
    def root(self) -> str:
        return self.case

    def place(self, envelope: str, case: PayloadCase) -> str:
        return "the whole frame"

    def members_of(self, frame: Message) -> Sequence[str]:
        return [self.case]

    def payload(self, frame: Message, case: str) -> Message:
        return frame

    def put(self, frame: Message, case: str, payload: Message) -> None:
        frame.CopyFrom(payload)

    def all_members(self, envelope: Envelope, frame: bytes) -> Sequence[str]:
        return [self.case]

    def first_number(self, datagram: bytes, numbers: Container[int]) -> int:
        return ONLY_CASE


Choice = Union[ByOneof, ByFrame]

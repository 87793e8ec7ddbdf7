"""Sections: the fields of a message that routines use, and their slots.

Expressions get fields from the section of a message. Other fields are not read.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.compiler.lowering.operations import Slot
from router.declared import Scalar
from router.types.descriptors import message_of
from router.types.model import Bool, Float, Int, List, MessageType, String, Type
from router.types.model import Field as Member


@dataclass(slots=True)
class Wanted:
    """A field that routines use: its value or list, its presence, or fields of its message.

    The value of a ROS message is a list with the message as its only element.
    """

    member: Member
    value: Slot | None = None
    presence: Slot | None = None
    section: Section | None = None


@dataclass(eq=False, slots=True)
class Section:
    """A message at one place: the source message, a message in it, or an element of a list.

    `descriptor` is None for a ROS message. `path` is the prefix of its fields' names: `motors[].`.
    """

    type: MessageType
    descriptor: Descriptor | None
    path: str = ""
    wanted: dict[str, Wanted] = field(default_factory=dict)
    index: int = -1

    @property
    def is_cdr(self) -> bool:
        return self.descriptor is None

    def _field(self, member: Member) -> Wanted:
        return self.wanted.setdefault(member.name, Wanted(member))

    def declared(self, member: Member) -> FieldDescriptor:
        """Return the descriptor of a field of a protobuf message."""
        assert self.descriptor is not None  # noqa: S101 - the caller ensures it
        return self.descriptor.fields_by_name[member.name]

    def inner(self, member: Member) -> Section:
        """Return a new section for the message in a field, or for the elements of a list."""
        is_list = isinstance(member.type, List)
        declared = member.type.element if isinstance(member.type, List) else member.type
        assert isinstance(declared, MessageType)  # noqa: S101 - the caller ensures it
        descriptor = None if self.is_cdr else message_of(self.declared(member))
        return Section(declared, descriptor, f"{self.path}{member.name}{'[]' * is_list}.")

    def message(self, member: Member) -> Section:
        """Return the section of the message in a field that is not a list."""
        wanted = self._field(member)
        if wanted.section is None:
            wanted.section = self.inner(member)
        return wanted.section

    def value(self, member: Member) -> Slot:
        """Return the slot of a scalar, text, bytes or list."""
        wanted = self._field(member)
        if wanted.value is None:
            wanted.value = Slot(self._default(member), self.path + member.name)
        return wanted.value

    def presence(self, member: Member) -> Slot:
        wanted = self._field(member)
        if wanted.presence is None:
            wanted.presence = Slot(0, f"has({self.path}{member.name})")
        return wanted.presence

    def stored(self, member: Member) -> Scalar:
        """Return how a list is stored."""
        assert isinstance(member.type, List)  # noqa: S101 - the caller ensures it
        is_scalar = not isinstance(member.type.element, (MessageType, String))
        return scalar_of(member.type.element) if self.is_cdr and is_scalar else Scalar.IN_CELLS

    def is_unchecked(self, member: Member) -> bool:
        """Return whether a text may not be UTF-8."""
        return self.is_cdr or member.is_unchecked

    def depth(self) -> int:
        return 1 + max((field.section.depth() for field in self.wanted.values() if field.section), default=0)

    def _default(self, member: Member) -> int | float | bytes | None:
        if isinstance(member.type, (List, MessageType)):
            return None
        if self.is_cdr:
            return b"" if isinstance(member.type, String) else 0.0 if isinstance(member.type, Float) else 0
        value: int | float | bytes | str = self.declared(member).default_value
        return value.encode() if isinstance(value, str) else value


_INTEGERS = {
    (8, True): Scalar.INT8, (8, False): Scalar.UINT8, (16, True): Scalar.INT16, (16, False): Scalar.UINT16,
    (32, True): Scalar.INT32, (32, False): Scalar.UINT32, (64, True): Scalar.INT64, (64, False): Scalar.UINT64,
}  # fmt: skip


def scalar_of(declared: Type) -> Scalar:
    """Return the scalar of a primitive ROS type other than a string."""
    match declared:
        case Bool():
            return Scalar.BOOL
        case Int(bits, signed):
            return _INTEGERS[bits, signed]
        case Float(bits):
            return Scalar.FLOAT32 if bits == 32 else Scalar.FLOAT64
        case _:
            raise AssertionError(f"{declared} is not a scalar of a ROS message")


def size_of(declared: Type) -> int:
    """Return the size in bytes, which is also the alignment, of a primitive ROS type other than a string."""
    return 1 if isinstance(declared, Bool) else declared.bits // 8  # type: ignore[union-attr]  # an Int or a Float

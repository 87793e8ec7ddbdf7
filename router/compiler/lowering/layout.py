"""Layouts: the slots into which the fields that routines use are read.

A layout numbers slots and sections. For a datagram it has the wanted fields of each section, for a ROS message the
steps through it up to the last wanted field (`steps`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple, Union

from google.protobuf.descriptor import FieldDescriptor

from router.compiler.lowering.operations import Slot
from router.compiler.lowering.sections import Section, Wanted
from router.declared import NONE, FieldType, ReadKind, Scalar
from router.types.descriptors import enum_of
from router.types.wire import encoding_of


class WantedField(NamedTuple):
    """`struct wanted_field`; NONE for a missing slot, section or enum."""

    number: int
    type: FieldType
    is_repeated: bool
    slot: int
    presence: int
    section: int
    choice: int = NONE
    cleared: int = 0
    cleared_count: int = 0
    closed: int = NONE


class ReadOperation(NamedTuple):
    """`struct read_operation`."""

    kind: ReadKind
    size: int = 0
    type: Scalar = Scalar.BOOL
    slot: int = NONE
    elements: int = 0


class PlacedSection(NamedTuple):
    """`struct section`: fields of a protobuf message, or the steps through a ROS message."""

    reads: tuple[Union[WantedField, ReadOperation], ...]
    first_slot: int
    slot_count: int


@dataclass(frozen=True, slots=True)
class Layout:
    """`struct layout`. The first section is the source message.

    `envelope` is the section of the envelope, 0 if no routine needs it. `closed` are the numbers
    of closed enums, ascending. `names` describe the slots and `messages` the sections, for `explain`.
    """

    is_cdr: bool
    sections: tuple[PlacedSection, ...]
    defaults: tuple[int | float | bytes | None, ...]
    names: tuple[str, ...]
    messages: tuple[str, ...]
    closed: tuple[tuple[int, ...], ...] = ()
    envelope: int = 0


class Numbering:
    """Numbers slots. Those of a section are consecutive."""

    def __init__(self, slots: Sequence[Slot]) -> None:
        self.defaults: list[int | float | bytes | None] = []
        self.names: list[str] = []
        self.sections: list[PlacedSection] = []
        self.messages: list[str] = []
        for slot in slots:
            self.number(slot)

    def number(self, slot: Slot) -> int:
        slot.index = len(self.defaults)
        self.defaults.append(slot.default)
        self.names.append(slot.name)
        return slot.index

    def number_sections(self, sections: Sequence[Section]) -> None:
        for index, section in enumerate(sections):
            section.index = index
        self.sections = [PlacedSection((), 0, 0)] * len(sections)
        self.messages = [section.type.name for section in sections]

    def made(self, *, is_cdr: bool, closed: Iterable[tuple[int, ...]] = (), envelope: int = 0) -> Layout:
        sections, defaults, names, messages = self.sections, self.defaults, self.names, self.messages
        return Layout(is_cdr, tuple(sections), tuple(defaults), tuple(names), tuple(messages), tuple(closed), envelope)


# ---- datagrams


def protobuf_layout(
    slots: Sequence[Slot], payload: Section, envelope: Section | None, elements: Sequence[Section]
) -> Layout:
    """Number `slots` from 0, then those of the payload, the envelope and list elements. Return the layout."""
    maker = _ProtobufNumbering(slots)
    around = [envelope] if envelope is not None else []
    roots = [payload, *around, *elements]
    maker.number_sections([*chain.from_iterable(map(_all, roots))])
    for root in roots:
        maker.place(root)
    return maker.made(is_cdr=False, closed=maker.closed.values(), envelope=around[0].index if around else 0)


def _all(section: Section) -> Iterator[Section]:
    yield section
    for wanted in section.wanted.values():
        if wanted.section is not None:
            yield from _all(wanted.section)


class _ProtobufNumbering(Numbering):
    """Numbers slots for a datagram. The members of a oneof follow the slot with the number of the current member."""

    def __init__(self, slots: Sequence[Slot]) -> None:
        super().__init__(slots)
        self.closed: dict[str, tuple[int, ...]] = {}

    def place(self, section: Section) -> None:
        first = len(self.defaults)
        declared = {name: section.declared(wanted.member) for name, wanted in section.wanted.items()}
        alone = [name for name, member in declared.items() if member.containing_oneof is None]
        fields = [self._field(declared[name], section.wanted[name]) for name in alone]
        oneofs = {member.containing_oneof for member in declared.values() if member.containing_oneof is not None}
        for oneof in sorted(oneofs, key=lambda oneof: oneof.index):
            choice, begin = self.number(Slot(0, f"member of {section.path}{oneof.name}")), len(self.defaults)
            members = [self._field(member, section.wanted.get(member.name)) for member in oneof.fields]
            count = len(self.defaults) - begin
            fields += [member._replace(choice=choice, cleared=begin, cleared_count=count) for member in members]
        fields.sort(key=lambda field: field.number)
        self.sections[section.index] = PlacedSection(tuple(fields), first, len(self.defaults) - first)

    def _field(self, declared: FieldDescriptor, wanted: Wanted | None) -> WantedField:
        slots = (wanted.value, wanted.presence) if wanted is not None else (None, None)
        slot, presence = (self.number(wanted_slot) if wanted_slot is not None else NONE for wanted_slot in slots)
        section = wanted.section if wanted is not None else None
        if section is not None:
            self.place(section)
        closed = self._closed(declared)
        return WantedField(
            declared.number,
            encoding_of(declared).read if closed == NONE else FieldType.CLOSED_ENUM,
            declared.is_repeated,
            slot,
            presence,
            section.index if section is not None else NONE,
            closed=closed,
        )

    def _closed(self, declared: FieldDescriptor) -> int:
        if declared.enum_type is None or not enum_of(declared).is_closed:
            return NONE
        enum = enum_of(declared)
        self.closed.setdefault(enum.full_name, tuple(sorted({value.number for value in enum.values})))
        return list(self.closed).index(enum.full_name)

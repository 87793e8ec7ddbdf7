"""The arrays of lowered routines: operations, layouts and values, as `native/operations.h` declares them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from router import declared as c
from router.compiler.lowering.layout import Layout, PlacedSection, ReadOperation, WantedField
from router.compiler.lowering.operations import Routine


@dataclass(slots=True)
class Routines:
    """Makes the routines of one layout. `arrays` gets what has to live as long as they do."""

    _layout: Layout
    arrays: list[object]
    _literals: bytearray = field(default_factory=bytearray)

    def routine(self, routine: Routine) -> c.Routine:
        if not routine:
            return c.Routine()
        made = (c.Operation * len(routine))()
        for to, (kind, slot, flag, size, number, data) in zip(made, routine, strict=True):
            if data:
                number = len(self._literals)  # noqa: PLW2901 - where the data stands
                self._literals += data
            to.kind, to.flag, to.size = kind, flag, size
            to.slot = slot if isinstance(slot, int) else slot.index
            if isinstance(number, float):
                to.real = number
            else:
                to.integer = number
        self.arrays.append(made)
        return c.Routine(operations=made, count=len(routine))

    def layout(self) -> Any:
        """A pointer to the layout, once all routines were made: its literals are theirs."""
        layout = self._layout
        sections = [self._section(section) for section in layout.sections]
        closed = [self._closed(numbers) for numbers in layout.closed]
        made = c.Layout(
            sections=(c.Section * len(sections))(*sections),
            defaults=native_values(layout.defaults, self.arrays),
            closed=(c.ClosedEnum * len(closed))(*closed),
            literals=bytes(self._literals),
            slot_count=len(layout.defaults),
            is_cdr=layout.is_cdr,
        )
        self.arrays.append(made)
        return ctypes.pointer(made)

    def _section(self, section: PlacedSection) -> c.Section:
        made = c.Section(count=len(section.reads), first_slot=section.first_slot, slot_count=section.slot_count)
        reads = map(_native_read, section.reads)
        if self._layout.is_cdr:
            made.steps = (c.ReadOperation * made.count)(*reads)
        else:
            made.fields = (c.WantedField * made.count)(*reads)
        self.arrays.append(made)
        return made

    def _closed(self, numbers: Sequence[int]) -> c.ClosedEnum:
        made = (ctypes.c_int32 * len(numbers))(*numbers)
        self.arrays.append(made)
        return c.ClosedEnum(numbers=made, count=len(numbers))


def _native_read(read: WantedField | ReadOperation) -> c.WantedField | c.ReadOperation:
    if isinstance(read, WantedField):
        return c.WantedField(**read._asdict())
    return c.ReadOperation(kind=read.kind, size=read.size, type=read.type, slot=read.slot, count=read.elements)


def native_values(values: Sequence[int | float | bytes | None], arrays: list[object]) -> ctypes.Array[c.Value]:
    """What slots hold: for a list, which is empty, None."""
    made = (c.Value * len(values))()
    for to, value in zip(made, values, strict=True):
        if isinstance(value, bytes):
            to.bytes, to.size = value, len(value)
        elif isinstance(value, float):
            to.real = value
        else:
            to.integer = value or 0
    arrays.append(made)
    return made

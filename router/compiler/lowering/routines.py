"""The arrays of lowered routines: operations, layouts and values, as `native/operations.h` declares them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from router import declared as c
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.layout import Layout, PlacedSection, ReadOperation, WantedField
from router.compiler.lowering.operations import Routine


@dataclass(slots=True)
class Routines:
    """Makes the routines of one layout. `arrays` owns their memory; `states` are the settings of the table's states."""

    _layout: Layout
    arrays: Arrays
    states: Any = None
    _literals: bytearray = field(default_factory=bytearray)

    def routine(self, routine: Routine) -> c.Routine:
        if not routine:
            return c.Routine()
        operations = self.arrays.add((c.Operation * len(routine))())
        for to, (kind, slot, flag, size, number, data) in zip(operations, routine, strict=True):
            if data:
                number = len(self._literals)  # noqa: PLW2901 - the position of the data
                self._literals += data
            to.kind, to.flag, to.size = kind, flag, size
            to.slot = slot if isinstance(slot, int) else slot.index
            if isinstance(number, float):
                to.real = number
            else:
                to.integer = number
        return c.Routine(operations=operations, count=len(routine))

    def layout(self) -> Any:
        """Return a pointer to the layout. Call it once all routines are made, as it contains their literals."""
        layout = self._layout
        sections = [self._section(section) for section in layout.sections]
        closed = [self._closed(numbers) for numbers in layout.closed]
        native = c.Layout(
            sections=self.arrays.array(c.Section, sections),
            defaults=native_values(layout.defaults, self.arrays),
            closed=self.arrays.array(c.ClosedEnum, closed),
            literals=self.arrays.text(bytes(self._literals)),
            slot_count=len(layout.defaults),
            is_cdr=layout.is_cdr,
            envelope=layout.envelope,
            states=self.states,
        )
        return ctypes.pointer(self.arrays.add(native))

    def _section(self, section: PlacedSection) -> c.Section:
        native = c.Section(count=len(section.reads), first_slot=section.first_slot, slot_count=section.slot_count)
        reads = [*map(_native_read, section.reads)]
        if self._layout.is_cdr:
            native.steps = self.arrays.array(c.ReadOperation, reads)
        else:
            native.fields = self.arrays.array(c.WantedField, reads)
        return native

    def _closed(self, numbers: Sequence[int]) -> c.ClosedEnum:
        return c.ClosedEnum(numbers=self.arrays.array(ctypes.c_int32, numbers), count=len(numbers))


def _native_read(read: WantedField | ReadOperation) -> c.WantedField | c.ReadOperation:
    if isinstance(read, WantedField):
        return c.WantedField(**read._asdict())
    return c.ReadOperation(kind=read.kind, size=read.size, type=read.type, slot=read.slot, count=read.elements)


def native_values(values: Sequence[int | float | bytes | None], arrays: Arrays) -> Any:
    """Make the contents of slots; None stands for an empty list."""
    natives = arrays.add((c.Value * len(values))())
    for to, value in zip(natives, values, strict=True):
        if isinstance(value, bytes):
            to.bytes, to.size = arrays.text(value), len(value)
            arrays.references.append(ctypes.addressof(to))
        elif isinstance(value, float):
            to.real = value
        else:
            to.integer = value or 0
    return natives

"""The arrays of lowered programs: operations, layouts and values, as `native/operations.h` declares them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from router import declared as c
from router.compiler.lowering.layout import Layout, NodeField, PlacedNode, ReadOperation
from router.compiler.lowering.operations import Code


@dataclass(slots=True)
class Programs:
    """Makes the programs of one layout. `arrays` gets what has to live as long as they do."""

    _layout: Layout
    arrays: list[object]
    _literals: bytearray = field(default_factory=bytearray)

    def code(self, code: Code) -> c.Code:
        if not code:
            return c.Code()
        made = (c.Operation * len(code))()
        for to, (kind, slot, flag, size, number, data) in zip(made, code, strict=True):
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
        return c.Code(operations=made, count=len(code))

    def layout(self) -> Any:
        """A pointer to the layout, once all code was made: its literals are those of the code."""
        layout = self._layout
        nodes = [self._node(node) for node in layout.nodes]
        closed = [self._closed(numbers) for numbers in layout.closed]
        made = c.Layout(
            nodes=(c.Node * len(nodes))(*nodes),
            defaults=native_values(layout.defaults, self.arrays),
            closed=(c.ClosedEnum * len(closed))(*closed),
            literals=bytes(self._literals),
            slot_count=len(layout.defaults),
            is_cdr=layout.is_cdr,
        )
        self.arrays.append(made)
        return ctypes.pointer(made)

    def _node(self, node: PlacedNode) -> c.Node:
        made = c.Node(count=len(node.entries), first_slot=node.first_slot, slot_count=node.slot_count)
        entries = map(_native_entry, node.entries)
        if self._layout.is_cdr:
            made.steps = (c.ReadOperation * made.count)(*entries)
        else:
            made.fields = (c.NodeField * made.count)(*entries)
        self.arrays.append(made)
        return made

    def _closed(self, numbers: Sequence[int]) -> c.ClosedEnum:
        made = (ctypes.c_int32 * len(numbers))(*numbers)
        self.arrays.append(made)
        return c.ClosedEnum(numbers=made, count=len(numbers))


def _native_entry(entry: NodeField | ReadOperation) -> c.NodeField | c.ReadOperation:
    if isinstance(entry, NodeField):
        return c.NodeField(**entry._asdict())
    return c.ReadOperation(kind=entry.kind, size=entry.size, type=entry.type, slot=entry.slot, count=entry.elements)


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

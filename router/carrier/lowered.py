"""The arrays of lowered programs: operations, layouts and values, as `native/operations.h` declares them."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from router.carrier import structures as c
from router.compiler.lowering.layout import Layout, NodeField, PlacedNode, ReadOperation
from router.compiler.lowering.operations import Code

_OPERATION, _REAL_OPERATION = struct.Struct("@BBHIQ"), struct.Struct("@BBHId")
"""`struct operation`, with an integer and with a real number."""

_64_BITS = (1 << 64) - 1


@dataclass(slots=True)
class Programs:
    """Makes the programs of one layout. `arrays` gets what has to live as long as they do."""

    _layout: Layout
    arrays: list[object]
    _literals: bytearray = field(default_factory=bytearray)

    def code(self, code: Code) -> c.Code:
        if not code:
            return c.Code()
        packed = bytearray()
        for kind, slot, flag, size, number, data in code:
            if data:
                number = len(self._literals)  # noqa: PLW2901 - where the data stands
                self._literals += data
            at = slot if isinstance(slot, int) else slot.index
            if isinstance(number, float):
                packed += _REAL_OPERATION.pack(kind, flag, at, size, number)
            else:
                packed += _OPERATION.pack(kind, flag, at, size, number & _64_BITS)
        made = (c.Operation * len(code)).from_buffer(packed)
        self.arrays.append(made)
        return c.Code(operations=made, count=len(code))

    def layout(self) -> Any:
        """A pointer to the layout, once all code was made: its literals are those of the code."""
        layout, literals = self._layout, ctypes.create_string_buffer(bytes(self._literals))
        nodes = [self._node(node) for node in layout.nodes]
        closed = [self._closed(numbers) for numbers in layout.closed]
        made = c.Layout(
            nodes=(c.Node * len(nodes))(*nodes),
            defaults=native_values(layout.defaults, self.arrays),
            closed=(c.ClosedEnum * len(closed))(*closed),
            literals=ctypes.addressof(literals),
            slot_count=len(layout.defaults),
            is_cdr=layout.is_cdr,
        )
        self.arrays += [literals, made]
        return ctypes.pointer(made)

    def _node(self, node: PlacedNode) -> c.Node:
        kind: Any = c.ReadOperation if self._layout.is_cdr else c.NodeField
        made = (kind * len(node.entries))(*map(_native_entry, node.entries))
        self.arrays.append(made)
        return c.Node(ctypes.addressof(made), len(node.entries), node.first_slot, node.slot_count)

    def _closed(self, numbers: Sequence[int]) -> c.ClosedEnum:
        made = (ctypes.c_int32 * len(numbers))(*numbers)
        self.arrays.append(made)
        return c.ClosedEnum(made, len(numbers))


def _native_entry(entry: NodeField | ReadOperation) -> c.NodeField | c.ReadOperation:
    if isinstance(entry, NodeField):
        return c.NodeField(*entry)
    return c.ReadOperation(entry.kind, entry.size, entry.type, slot=entry.slot, count=entry.elements)


def native_values(values: Sequence[int | float | bytes | None], arrays: list[object]) -> ctypes.Array[c.Value]:
    """What slots hold: for a list, which is empty, None."""
    made = (c.Value * len(values))()
    for to, value in zip(made, values, strict=True):
        if isinstance(value, bytes):
            data = ctypes.create_string_buffer(value)
            arrays.append(data)
            to.bits, to.size = ctypes.addressof(data), len(value)
        elif isinstance(value, float):
            (to.bits,) = struct.unpack("@Q", struct.pack("@d", value))
        else:
            to.bits = (value or 0) & _64_BITS
    arrays.append(made)
    return made

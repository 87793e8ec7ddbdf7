"""Hand-written programs for the machine in C (`operations.h`), and their results."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref, c_bool, c_int, c_size_t, c_uint32, c_void_p
from dataclasses import dataclass, field
from pathlib import Path

from router import declared as c
from router.carrier.build import NATIVE, compile_c
from tests.carrier.building import MEMORY, sanitizing

SOURCES = ("machine.c", "read_protobuf.c", "read_cdr.c", "evaluate.c")
CDR_HEADER = b"\0\1\0\0"


C = c.ENUMERATORS
"""Constants of the headers, by name."""

_DROP_REASONS = {C["DROP_MAPPING_ERROR"]: "mapping_error", C["DROP_NON_FINITE"]: "non_finite"}
INTEGER, REAL, TEXT, LIST = "integer", "real", "text", "list"


@dataclass(frozen=True)
class Operation:
    """`struct operation`."""

    name: str
    slot: int = 0
    flag: int = 0
    size: int = 0
    number: int | float = 0
    data: bytes | None = None
    """Stored in the literals; sets `number` and, unless given, `size`."""

    def packed(self, literals: bytearray) -> bytes:
        """The bytes of the operation. Appends its data to the literals if they lack it."""
        size, number = self.size, self.number
        if self.data is not None:
            size, number = self.size or len(self.data), literals.find(self.data)
            if number < 0:
                number = len(literals)
                literals += self.data
        made = c.Operation(C[self.name], self.flag, self.slot, size)
        if isinstance(number, float):
            made.real = number
        else:
            made.integer = number
        return bytes(made)


@dataclass(frozen=True)
class Step:
    """`struct read_operation`."""

    kind: str
    slot: int = c.NONE
    size: int = 0
    type: str = "SCALAR_BOOL"
    count: int = 0

    def packed(self) -> bytes:
        return bytes(c.ReadOperation(C[self.kind], self.size, C[self.type], slot=self.slot, count=self.count))


@dataclass(frozen=True)
class WantedField:
    """`struct wanted_field`."""

    number: int
    type: str
    slot: int = c.NONE
    is_repeated: bool = False
    presence: int = c.NONE
    section: int = c.NONE
    choice: int = c.NONE
    cleared: tuple[int, int] = (0, 0)
    closed: int = c.NONE

    def packed(self) -> bytes:
        fixed = self.slot, self.presence, self.section, self.choice, *self.cleared, self.closed
        return bytes(c.WantedField(self.number, C[self.type], self.is_repeated, *fixed))


@dataclass(frozen=True)
class Section:
    reads: Sequence[WantedField | Step]
    first_slot: int = 0
    slot_count: int = 0


@dataclass(frozen=True)
class Refusal:
    reason: str
    at: int


@dataclass
class Layout:
    sections: Sequence[Section] = (Section(()),)
    slot_count: int = 64
    closed: Sequence[Sequence[int]] = ()
    is_cdr: bool = False
    defaults: dict[int, int | float | bytes] = field(default_factory=dict)
    """Initial values of slots, other than zero and the empty list."""


def evaluating(output: Path, *, is_sanitized: bool) -> ctypes.CDLL:
    """The machine and the functions of evaluating.c, compiled to the library `output`."""
    flags = [*(sanitizing(MEMORY) if is_sanitized else ["-O1"]), "-fPIC", "-shared", f"-I{NATIVE}"]
    files = [str(Path(__file__).parent / "evaluating.c"), *(str(NATIVE / name) for name in SOURCES)]
    compile_c([*flags, *files, "-o", str(output)], "gcc" if is_sanitized else None)
    loaded = ctypes.CDLL(str(output))
    loaded.seam_machine_open.restype, loaded.seam_machine_open.argtypes = c_void_p, ()
    loaded.seam_machine_close.restype, loaded.seam_machine_close.argtypes = None, (c_void_p,)
    loaded.seam_machine_read.restype = c_bool
    loaded.seam_machine_read.argtypes = (c_void_p, c_void_p, c_void_p, c_size_t)
    for name in ("slots", "cells", "output"):
        getattr(loaded, f"seam_machine_{name}").restype = c_void_p
    loaded.seam_machine_slots.argtypes = loaded.seam_machine_cells.argtypes = (c_void_p,)
    loaded.seam_machine_output.argtypes = (c_void_p, c_void_p)
    loaded.evaluate_condition.restype = loaded.seam_machine_value.restype = loaded.evaluate_message.restype = c_int
    loaded.evaluate_condition.argtypes = loaded.seam_machine_value.argtypes = (c_void_p,) * 4
    loaded.evaluate_message.argtypes = (c_void_p,) * 3
    return loaded


class Machine:
    """A machine with a layout, to run programs on."""

    def __init__(self, library: ctypes.CDLL, layout: Layout | None = None) -> None:
        self._library = library
        self._address = library.seam_machine_open()
        self._kept: list[object] = []
        self._literals = bytearray()
        self._layout = self._native_layout(layout or Layout())

    def __del__(self) -> None:
        self._library.seam_machine_close(self._address)

    def read(self, data: bytes = CDR_HEADER) -> bool:
        """Start with a message, whose section is the first one. Without a layout nothing is read."""
        copy = (ctypes.c_char * len(data)).from_buffer_copy(data) if data else b""  # exact size, for sanitizers
        self._message = copy
        return bool(self._library.seam_machine_read(self._address, byref(self._layout), copy, len(data)))

    def slot(self, index: int) -> int:
        return int(c.Value.from_address(self._library.seam_machine_slots(self._address) + 16 * index).bits)

    def listed(self, index: int, of: str = INTEGER) -> list[object]:
        """The list of a slot, as cells."""
        return self._elements(c.Value.from_address(self._library.seam_machine_slots(self._address) + 16 * index), of)

    def value(self, *routine: Operation, of: str = INTEGER) -> object:
        """The result of a program on the stack: an int64 for INTEGER; for LISTs the elements' cells as integers."""
        value, at = c.Value(), c_uint32()
        made = self._routine(routine)
        outcome = self._library.seam_machine_value(self._address, byref(made), byref(value), byref(at))
        return self._made(value, of) if outcome == c.EVALUATED else Refusal(_DROP_REASONS[outcome], at.value)

    def condition(self, *routine: Operation) -> bool | Refusal:
        is_true, at = c_bool(), c_uint32()
        made = self._routine(routine)
        outcome = self._library.evaluate_condition(self._address, byref(made), byref(is_true), byref(at))
        return is_true.value if outcome == c.EVALUATED else Refusal(_DROP_REASONS[outcome], at.value)

    def message(self, *routine: Operation) -> bytes | Refusal:
        at, size = c_uint32(), c_size_t()
        made = self._routine(routine)
        outcome = self._library.evaluate_message(self._address, byref(made), byref(at))
        if outcome != c.EVALUATED:
            return Refusal(_DROP_REASONS[outcome], at.value)
        return ctypes.string_at(self._library.seam_machine_output(self._address, byref(size)), size.value)

    def _made(self, value: c.Value, of: str) -> object:
        if of == INTEGER:
            return value.integer
        if of == REAL:
            return value.real
        if of == TEXT:
            return ctypes.string_at(value.bits, value.size)
        return self._elements(value, INTEGER)

    def _elements(self, value: c.Value, of: str) -> list[object]:
        cells = self._library.seam_machine_cells(self._address)
        index, made = value.list.first, []
        for _ in range(value.size):
            cell = c.Cell.from_address(cells + ctypes.sizeof(c.Cell) * index)
            made.append(self._made(cell.value, of))
            index = cell.next
        return made

    def _keep(self, data: bytes) -> int:
        array = ctypes.create_string_buffer(data, max(1, len(data)))
        self._kept.append(array)
        return ctypes.addressof(array)

    def _native_layout(self, layout: Layout) -> c.Layout:
        sections = [self._section(section, is_cdr=layout.is_cdr) for section in layout.sections]
        closed = [c.ClosedEnum((ctypes.c_int32 * len(each))(*each), len(each)) for each in layout.closed]
        defaults = (c.Value * layout.slot_count)()
        for index, value in layout.defaults.items():
            if isinstance(value, bytes):
                defaults[index].bits, defaults[index].size = self._keep(value), len(value)
            elif isinstance(value, float):
                defaults[index].real = value
            else:
                defaults[index].integer = value
        self._room = ctypes.create_string_buffer(1 << 16)
        return c.Layout(
            sections=(c.Section * len(sections))(*sections),
            defaults=defaults,
            closed=(c.ClosedEnum * len(closed))(*closed),
            literals=ctypes.addressof(self._room),
            slot_count=layout.slot_count,
            is_cdr=layout.is_cdr,
        )

    def _section(self, section: Section, *, is_cdr: bool) -> c.Section:
        reads = self._keep(b"".join(each.packed() for each in section.reads))
        made = c.Section(count=len(section.reads), first_slot=section.first_slot, slot_count=section.slot_count)
        if is_cdr:
            made.steps = ctypes.cast(reads, ctypes.POINTER(c.ReadOperation))
        else:
            made.fields = ctypes.cast(reads, ctypes.POINTER(c.WantedField))
        return made

    def _routine(self, operations: Sequence[Operation]) -> c.Routine:
        packed = b"".join(each.packed(self._literals) for each in operations)
        ctypes.memmove(self._room, bytes(self._literals), len(self._literals))
        return c.Routine((c.Operation * len(operations)).from_buffer_copy(packed), len(operations))


def integer(value: int) -> Operation:
    return Operation("OP_INTEGER", number=value)


def real(value: float) -> Operation:
    return Operation("OP_REAL", number=float(value))


def text(value: bytes) -> Operation:
    return Operation("OP_TEXT", data=value)


def load(slot: int) -> Operation:
    return Operation("OP_LOAD", slot)

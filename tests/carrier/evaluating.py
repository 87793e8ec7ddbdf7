"""Programs for the machine in C (`operations.h`), put together by hand, and what becomes of them."""

from __future__ import annotations

import ctypes
import re
import struct
from collections.abc import Sequence
from ctypes import byref, c_bool, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass, field
from pathlib import Path

from router.carrier.build import NATIVE, compile_c
from tests.carrier.building import MEMORY, sanitizing

SOURCES = ("machine.c", "read_protobuf.c", "read_cdr.c", "evaluate.c")
NONE, EVALUATED = 0xFFFF, -1
CDR_HEADER = b"\0\1\0\0"


def _numbers() -> dict[str, int]:
    """The constants of the enums in operations.h and events.h."""
    numbers: dict[str, int] = {}
    for header in ("operations.h", "events.h"):
        text = re.sub(r"/\*.*?\*/", "", (NATIVE / header).read_text(), flags=re.DOTALL)
        for body in re.findall(r"enum(?: \w+)? \{(.*?)\}", text, re.DOTALL):
            following = 0
            for name, value in re.findall(r"([A-Z]\w*)(?: = ([^,]+))?", body):
                following = int(value) if value.strip().isdigit() else following
                numbers[name] = following
                following += 1
    return numbers


C = _numbers()
"""Constants of the headers, by name."""

_LOSSES = {C["LOSS_MAPPING_ERROR"]: "mapping_error", C["LOSS_NON_FINITE"]: "non_finite"}
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
    """Stands in the literals: `number` and, unless it is given, `size` follow from it."""

    def packed(self, literals: bytearray) -> bytes:
        """With its data in the literals, which grow if they do not have them."""
        size, number = self.size, self.number
        if self.data is not None:
            size, number = self.size or len(self.data), literals.find(self.data)
            if number < 0:
                number = len(literals)
                literals += self.data
        head = struct.pack("<BBHI", C[self.name], self.flag, self.slot, size)
        return head + (
            struct.pack("<d", number) if isinstance(number, float) else struct.pack("<Q", number % (1 << 64))
        )


@dataclass(frozen=True)
class Step:
    """`struct read_operation`."""

    kind: str
    slot: int = NONE
    size: int = 0
    type: str = "SCALAR_BOOL"
    count: int = 0

    def packed(self) -> bytes:
        return struct.pack("<4B2HI", C[self.kind], self.size, C[self.type], 0, self.slot, 0, self.count)


@dataclass(frozen=True)
class NodeField:
    """`struct node_field`."""

    number: int
    type: str
    slot: int = NONE
    is_repeated: bool = False
    presence: int = NONE
    node: int = NONE
    choice: int = NONE
    cleared: tuple[int, int] = (0, 0)
    closed: int = NONE

    def packed(self) -> bytes:
        fixed = self.slot, self.presence, self.node, self.choice, *self.cleared, self.closed
        return struct.pack("<I2B7H", self.number, C[self.type], self.is_repeated, *fixed)


@dataclass(frozen=True)
class Node:
    entries: Sequence[NodeField | Step]
    first_slot: int = 0
    slot_count: int = 0


class _Value(ctypes.Structure):
    _fields_ = (("bits", c_uint64), ("size", c_uint32), ("reserved", c_uint32))

    def real(self) -> float:
        return float(struct.unpack("<d", struct.pack("<Q", self.bits))[0])


class _Cell(ctypes.Structure):
    _fields_ = (("value", _Value), ("next", c_uint32), ("reserved", c_uint32))


class _Code(ctypes.Structure):
    _fields_ = (("operations", c_void_p), ("count", c_uint32), ("reserved", c_uint32))


class _Layout(ctypes.Structure):
    _fields_ = (
        ("nodes", c_void_p), ("defaults", c_void_p), ("closed", c_void_p), ("literals", c_void_p),
        ("slot_count", c_uint32), ("is_cdr", c_uint32),
    )  # fmt: skip


@dataclass(frozen=True)
class Refusal:
    reason: str
    at: int


@dataclass
class Layout:
    nodes: Sequence[Node] = (Node(()),)
    slot_count: int = 64
    closed: Sequence[Sequence[int]] = ()
    is_cdr: bool = False
    defaults: dict[int, int | float | bytes] = field(default_factory=dict)
    """Of slots that do not begin with zero or an empty list."""


def evaluating(output: Path, *, is_sanitized: bool) -> ctypes.CDLL:
    """The machine with the functions of evaluating.c, in a library that is made as `output`."""
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
    """A machine with a layout, which programs are run on."""

    def __init__(self, library: ctypes.CDLL, layout: Layout | None = None) -> None:
        self._library = library
        self._address = library.seam_machine_open()
        self._kept: list[object] = []
        self._literals = bytearray()
        self._layout = self._native_layout(layout or Layout())

    def __del__(self) -> None:
        self._library.seam_machine_close(self._address)

    def read(self, data: bytes = CDR_HEADER) -> bool:
        """Begin with a message: its node is the first one. Without a layout there is nothing to read."""
        copy = (ctypes.c_char * len(data)).from_buffer_copy(data) if data else b""  # exactly, for sanitizers
        self._message = copy
        return bool(self._library.seam_machine_read(self._address, byref(self._layout), copy, len(data)))

    def slot(self, index: int) -> int:
        return int(_Value.from_address(self._library.seam_machine_slots(self._address) + 16 * index).bits)

    def listed(self, index: int, of: str = INTEGER) -> list[object]:
        """A slot's list in cells."""
        return self._elements(_Value.from_address(self._library.seam_machine_slots(self._address) + 16 * index), of)

    def value(self, *code: Operation, of: str = INTEGER) -> object:
        """What a program leaves on the stack: an int64 for INTEGER, the elements of LISTs in cells as integers."""
        value, at = _Value(), c_uint32()
        made = self._code(code)
        outcome = self._library.seam_machine_value(self._address, byref(made), byref(value), byref(at))
        return self._made(value, of) if outcome == EVALUATED else Refusal(_LOSSES[outcome], at.value)

    def condition(self, *code: Operation) -> bool | Refusal:
        is_true, at = c_bool(), c_uint32()
        made = self._code(code)
        outcome = self._library.evaluate_condition(self._address, byref(made), byref(is_true), byref(at))
        return is_true.value if outcome == EVALUATED else Refusal(_LOSSES[outcome], at.value)

    def message(self, *code: Operation) -> bytes | Refusal:
        at, size = c_uint32(), c_size_t()
        made = self._code(code)
        outcome = self._library.evaluate_message(self._address, byref(made), byref(at))
        if outcome != EVALUATED:
            return Refusal(_LOSSES[outcome], at.value)
        return ctypes.string_at(self._library.seam_machine_output(self._address, byref(size)), size.value)

    def _made(self, value: _Value, of: str) -> object:
        if of == INTEGER:
            return int.from_bytes(struct.pack("<Q", value.bits), "little", signed=True)
        if of == REAL:
            return value.real()
        if of == TEXT:
            return ctypes.string_at(value.bits, value.size)
        return self._elements(value, INTEGER)

    def _elements(self, value: _Value, of: str) -> list[object]:
        cells = self._library.seam_machine_cells(self._address)
        index, made = value.bits & 0xFFFF_FFFF, []
        for _ in range(value.size):
            cell = _Cell.from_address(cells + ctypes.sizeof(_Cell) * index)
            made.append(self._made(cell.value, of))
            index = cell.next
        return made

    def _keep(self, data: bytes) -> int:
        array = ctypes.create_string_buffer(data, max(1, len(data)))
        self._kept.append(array)
        return ctypes.addressof(array)

    def _native_layout(self, layout: Layout) -> _Layout:
        nodes = b"".join(
            struct.pack("<QIHH", self._keep(b"".join(each.packed() for each in node.entries)), len(node.entries),
                        node.first_slot, node.slot_count)
            for node in layout.nodes
        )  # fmt: skip
        closed = b"".join(
            struct.pack("<QII", self._keep(struct.pack(f"<{len(numbers)}i", *numbers)), len(numbers), 0)
            for numbers in layout.closed
        )
        defaults = b"".join(self._default(layout.defaults.get(index, 0)) for index in range(layout.slot_count))
        self._kept.append(literals := ctypes.create_string_buffer(1 << 16))
        self._room = literals
        return _Layout(self._keep(nodes), self._keep(defaults), self._keep(closed), ctypes.addressof(literals),
                       layout.slot_count, layout.is_cdr)  # fmt: skip

    def _default(self, value: int | float | bytes) -> bytes:  # noqa: PYI041 - not the same here
        match value:
            case bytes():
                return struct.pack("<QII", self._keep(value), len(value), 0)
            case float():
                return struct.pack("<dII", value, 0, 0)
            case _:
                return struct.pack("<QII", value % (1 << 64), 0, 0)

    def _code(self, operations: Sequence[Operation]) -> _Code:
        packed = b"".join(each.packed(self._literals) for each in operations)
        ctypes.memmove(self._room, bytes(self._literals), len(self._literals))
        made = ctypes.create_string_buffer(packed, max(1, len(packed)))
        self._running = made
        return _Code(ctypes.addressof(made), len(operations), 0)


def integer(value: int) -> Operation:
    return Operation("OP_INTEGER", number=value)


def real(value: float) -> Operation:
    return Operation("OP_REAL", number=float(value))


def text(value: bytes) -> Operation:
    return Operation("OP_TEXT", data=value)


def load(slot: int) -> Operation:
    return Operation("OP_LOAD", slot)

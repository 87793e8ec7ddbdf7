"""The image of a compiled program: its memory as relocatable bytes, and a list of the objects to open for it.

Pointers within the image are stored as offsets, at the places in `relocations`. Pointers to opened objects are stored
as numbers of `symbols`, at the places in `imports`. A head start (`kept/head_start.py`) loads the image.
"""

from __future__ import annotations

import ctypes
from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any, TypeVar, cast

from router import declared as c
from router.carrier.boards import NativeBoards
from router.carrier.deadmen import DeadmanGroup
from router.carrier.deferrals import Adoption
from router.carrier.forwarding import KEPT_GENERATION
from router.carrier.names import Names
from router.carrier.outlets import Outlets
from router.carrier.program import NativeProgram, native_program
from router.carrier.state import State
from router.compiler.network import sent_from
from router.compiler.program import Program
from router.table.model import EndpointKind

T = TypeVar("T")
Parts = dict[str, Any]
"""Plain values for `marshal`."""

_FIRST = 1 << 56
"""The first symbol: higher than any address of a process."""
_WORD = 8
_ALIGNMENT = 16


def image_of(library: ctypes.CDLL, program: Program) -> tuple[Parts, bytes]:
    """Return the parts of a program that a head start needs, and its image. The program has counters of its own.

    Equal programs have equal images.
    """
    symbols = _Symbols()
    state = _Recorder(library, symbols)
    group = DeadmanGroup(library, symbols.address("deadmen"), state.names)
    senders = {each.name: symbols.of("sender", each.name) for each in program.senders}
    outlets = Outlets.of(
        program,
        group,
        state,
        listeners={each.name: _LISTENER for each in program.listeners},  # type: ignore[misc]
        senders=senders,
        publications={each.label: _Publication(symbols, each.label) for each in program.publishers},
        boards=NativeBoards(program.boards),
    )
    native = native_program(program, KEPT_GENERATION, outlets)
    adopted = [*outlets.pacers(), *native.states.adopted]
    memory = _Memory(native, symbols)
    image, relocations, imports = memory.image()
    parts: Parts = {
        "counters": program.counters.size,
        "mirror_lost": program.counters.index("mirror_dropped") if program.table.record is not None else None,
        "names": state.names.all(),
        "listeners": [
            (each.name, tuple(each.address.value), each.interface, each.receive_buffer) for each in program.listeners
        ],
        "senders": [
            (each.name, tuple(each.address.value), each.kind is EndpointKind.BOARD, sent_from(program.table, each))
            for each in program.senders
        ],
        "openings": state.openings,
        "deadmen": [(plan.route, [endpoint for endpoint, _ in plan.datagrams]) for plan in program.deadmen],
        "always_wanted": [each.label for each in program.publishers if each.qos.serves_late_joiners],
        "symbols": symbols.names,
        "relocations": relocations,
        "imports": imports,
        "program": memory.offset(ctypes.addressof(native.structure)),
        "listener_array": memory.offset(_address_in(native.structure, "listeners")) if program.listeners else 0,
        "adopted": [memory.adoption(each) for each in adopted],
    }
    return parts, image


class _Symbols:
    """Stand-ins for the addresses of opened objects."""

    def __init__(self) -> None:
        self.names: list[tuple[str | None, ...]] = []
        self._numbers: dict[tuple[str | None, ...], int] = {}

    def address(self, *name: str | None) -> int:
        if name not in self._numbers:
            self._numbers[name] = len(self.names)
            self.names.append(name)
        return _FIRST + self._numbers[name]

    def of(self, *name: str | None) -> _Symbol:
        return _Symbol(self.address(*name))


class _Symbol:
    def __init__(self, address: int) -> None:
        self.address = address


class _Publication:
    """Stands for `ros.endpoints.Publication`. The head start provides the byte `wanted`."""

    def __init__(self, symbols: _Symbols, topic: str) -> None:
        self.address = symbols.address("publisher", topic)
        self.wanted = (ctypes.c_uint8 * 1).from_address(symbols.address("wanted", topic))


_LISTENER = SimpleNamespace(is_inherited=False, socket=SimpleNamespace(fileno=lambda: -1))
"""Stands for `net.udp.Listener`: the head start fills in the socket."""


class _Recorder(State):
    """Opens nothing, but notes each object to open, in order: the place, the function, and plain arguments."""

    def __init__(self, library: ctypes.CDLL, symbols: _Symbols) -> None:
        super().__init__(library)
        self.names = Names()
        self.openings: list[tuple[tuple[str | None, ...], str, list[object]]] = []
        self._symbols = symbols

    def get_or_open(
        self, place: tuple[str | None, ...], rest: Hashable, wrap: Callable[[int], T], function: str, *arguments: object
    ) -> T:
        def make() -> _Symbol:
            self.openings.append((place, function, [_plain(each) for each in arguments]))
            return self._symbols.of("opened", *place)

        return cast("T", self.get_or_make((place, rest), make))


def _plain(argument: object) -> object:
    """Return an argument for the head start: (number,) for a symbol, a list for deadman destinations, or the value."""
    if isinstance(argument, ctypes.Array):
        return [
            (_plain(each.sender), [_bytes(datagram) for datagram in each.datagrams[: each.count]], each.sent,
             each.send_errors, each.id, each.follows, each.is_heard, each.last_seen, each.within,
             each.disobeyed, each.stopping)
            for each in argument
        ]  # fmt: skip
    if isinstance(argument, int) and argument >= _FIRST:
        return (argument - _FIRST,)
    return argument


def _bytes(datagram: c.DeadmanDatagram) -> bytes:
    return ctypes.string_at(_address_in(datagram, "data"), datagram.size)


def _address_in(structure: Any, field: str) -> int:
    """Return the address in a pointer field of a structure."""
    return ctypes.c_uint64.from_buffer(structure, getattr(type(structure), field).offset).value


class _Memory:
    """The blocks of a program, in the order in which they were made."""

    def __init__(self, native: NativeProgram, symbols: _Symbols) -> None:
        self._symbols = symbols
        self._references = {*native.arrays.references, *native.states.bound.references}
        self._blocks = [native.structure, *native.arrays.blocks, *native.states.bound.blocks]
        self._offsets: dict[int, int] = {}
        self._size = 0
        for block in self._blocks:
            self._offsets[ctypes.addressof(block)] = self._size
            self._size += -(-max(ctypes.sizeof(block), 1) // _ALIGNMENT) * _ALIGNMENT
        self._addresses = sorted(self._offsets)
        self._ends = {ctypes.addressof(block): ctypes.addressof(block) + ctypes.sizeof(block) for block in self._blocks}

    def offset(self, address: int) -> int:
        """Return the offset in the image of an address in a block. Raises LookupError if it is in no block."""
        if address in self._offsets:
            return self._offsets[address]
        before = self._addresses[bisect_right(self._addresses, address) - 1]
        if not before < address < self._ends[before]:
            raise LookupError(f"an array of the program refers to {address:#x}, which is not in its memory")
        return self._offsets[before] + address - before

    def adoption(self, adoption: Adoption) -> tuple[int, bool, int | None, int | None]:
        """Return the symbol of a timer, whether it is for a topic, and the offsets of its targets."""
        to, target = (None if each is None else self.offset(each) for each in (adoption.targets, adoption.target))
        return adoption.timer - _FIRST, adoption.is_topic, to, target

    def image(self) -> tuple[bytes, list[int], list[tuple[int, int]]]:
        """Return the bytes; the places of words that hold offsets; and the places of symbols, each with its number."""
        image = bytearray(self._size)
        relocations, imports = [], []
        for block in self._blocks:
            address, size = ctypes.addressof(block), ctypes.sizeof(block)
            begin = self._offsets[address]
            image[begin : begin + size] = ctypes.string_at(address, size)
            for at in self._pointers(block, address):
                word = (begin + at) // _WORD
                value = int.from_bytes(image[begin + at : begin + at + _WORD], "little")
                if value >= _FIRST:
                    imports.append((word, value - _FIRST))
                    value = 0
                elif value:
                    relocations.append(word)
                    value = self.offset(value)
                image[begin + at : begin + at + _WORD] = value.to_bytes(_WORD, "little")
        return bytes(image), relocations, imports

    def _pointers(self, block: Any, address: int) -> Iterator[int]:
        """Yield the offsets of pointers in a block."""
        for at, is_certain in _pointers_in(cast("Hashable", type(block))):
            if is_certain or address + at in self._references:
                yield at


@cache
def _pointers_in(kind: Any) -> tuple[tuple[int, bool], ...]:
    """Return the offsets of pointers in a C type. False marks one that may hold a number, as in a `struct value`."""
    if issubclass(kind, ctypes.Array):
        size, within = ctypes.sizeof(kind._type_), _pointers_in(kind._type_)
        return tuple(
            (begin + at, sure)
            for begin in (range(0, size * kind._length_, size) if within else ())
            for at, sure in within
        )
    if issubclass(kind, ctypes.Structure):
        fields = [(getattr(kind, name).offset, _pointers_in(field)) for name, field, *_ in kind._fields_]
        return tuple((begin + at, sure) for begin, within in fields for at, sure in within)
    if issubclass(kind, ctypes.Union):
        every = [_pointers_in(field) for _, field in kind._fields_]
        return ((0, all(every)),) if any(every) else ()
    return ((0, True),) if issubclass(kind, _POINTERS) else ()


_POINTERS = ctypes.c_void_p, ctypes.c_char_p, ctypes._Pointer

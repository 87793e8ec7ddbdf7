"""The memory of an image: the structures of a compiled table as relocatable bytes."""

from __future__ import annotations

import ctypes
from bisect import bisect_right
from collections.abc import Hashable, Iterator
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from router import declared as c
from router.compiler.lowering.arrays import Arrays

if TYPE_CHECKING:
    from router.image.image import Symbol

_FIRST = 1 << 56
"""The first symbol: higher than any address of a process."""
_WORD = 8
_ALIGNMENT = 16


class Symbols:
    """Numbers that stand for addresses, because what has them is not open yet."""

    def __init__(self) -> None:
        self.all: list[Symbol] = []
        self._numbers: dict[Symbol, int] = {}

    def address(self, *symbol: str | None) -> int:
        """Return a number that stands for the address; `number` converts it to the index of the symbol."""
        if symbol not in self._numbers:
            self._numbers[symbol] = len(self.all)
            self.all.append(symbol)
        return _FIRST + self._numbers[symbol]

    @staticmethod
    def number(address: int) -> int:
        return address - _FIRST


class Relocatable(NamedTuple):
    """The memory of an image, and lists of the words and fields to set in it, as in `Image`."""

    memory: bytes
    relocations: list[int]
    imports: list[tuple[int, list[int]]]
    generations: list[int]


class Memory:
    """The memory in `arrays`, one block after the other."""

    def __init__(self, arrays: Arrays) -> None:
        self._references = {*arrays.references}
        self._blocks = arrays.blocks
        self._offsets: dict[int, int] = {}
        self._size = 0
        for block in self._blocks:
            self._offsets[ctypes.addressof(block)] = self._size
            self._size += -(-max(ctypes.sizeof(block), 1) // _ALIGNMENT) * _ALIGNMENT
        self._addresses = sorted(self._offsets)
        self._ends = {ctypes.addressof(block): ctypes.addressof(block) + ctypes.sizeof(block) for block in self._blocks}

    def offset(self, address: int) -> int:
        """Return the offset of an address. Raises LookupError if it is in no block."""
        if address in self._offsets:
            return self._offsets[address]
        before = self._addresses[bisect_right(self._addresses, address) - 1]
        if not before < address < self._ends[before]:
            raise LookupError(f"an array of the image refers to {address:#x}, which is not in its memory")
        return self._offsets[before] + address - before

    def relocatable(self) -> Relocatable:
        """Return the bytes, in which pointers are offsets or, for symbols, 0."""
        image = bytearray(self._size)
        relocations: list[int] = []
        generations: list[int] = []
        imports: dict[int, list[int]] = {}
        for block in self._blocks:
            address, size, kind = ctypes.addressof(block), ctypes.sizeof(block), cast("Hashable", type(block))
            begin = self._offsets[address]
            image[begin : begin + size] = ctypes.string_at(address, size)
            generations += [begin + at for at in _generations_in(kind)]
            for at in self._pointers(kind, address):
                word = (begin + at) // _WORD
                value = int.from_bytes(image[begin + at : begin + at + _WORD], "little")
                if value >= _FIRST:
                    imports.setdefault(Symbols.number(value), []).append(word)
                    value = 0
                elif value:
                    relocations.append(word)
                    value = self.offset(value)
                image[begin + at : begin + at + _WORD] = value.to_bytes(_WORD, "little")
        return Relocatable(bytes(image), relocations, sorted(imports.items()), generations)

    def _pointers(self, kind: Hashable, address: int) -> Iterator[int]:
        """Yield the offsets of pointers in a block."""
        for at, is_certain in _pointers_in(kind):
            if is_certain or address + at in self._references:
                yield at


def address_in(structure: Any, field: str) -> int:
    """Return the address in a pointer field of a structure."""
    return ctypes.c_uint64.from_buffer(structure, getattr(type(structure), field).offset).value


@cache
def _pointers_in(kind: Any) -> tuple[tuple[int, bool], ...]:
    """Return the offsets of pointers in a C type. False marks one that may hold a number, as in a `struct value`."""
    if issubclass(kind, ctypes.Union):
        every = [_pointers_in(field) for _, field in kind._fields_]
        return ((0, all(every)),) if any(every) else ()
    if issubclass(kind, _POINTERS):
        return ((0, True),)
    return tuple((begin + at, sure) for begin, part in _parts(kind) for at, sure in _pointers_in(part))


@cache
def _generations_in(kind: Any) -> tuple[int, ...]:
    """Return the offsets of the fields for the number of the program in a C type."""
    if kind in (c.Program, c.Targets):
        return (kind.generation.offset,)
    return tuple(begin + at for begin, part in _parts(kind) for at in _generations_in(part))


def _parts(kind: Any) -> Iterator[tuple[int, Any]]:
    """Yield the elements of an array type or the members of a structure, with their offsets."""
    if issubclass(kind, ctypes.Array):
        size = ctypes.sizeof(kind._type_)
        if issubclass(kind._type_, (ctypes.Structure, ctypes.Array, ctypes.Union, *_POINTERS)):
            yield from ((begin, kind._type_) for begin in range(0, size * kind._length_, size))
    elif issubclass(kind, ctypes.Structure):
        yield from ((getattr(kind, name).offset, field) for name, field, *_ in kind._fields_)


_POINTERS = ctypes.c_void_p, ctypes.c_char_p, ctypes._Pointer

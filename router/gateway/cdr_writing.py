"""Numbers, truths, text and lists of them, checked and appended to the CDR bytes of a message.

Nothing is taken for what it is not: 3.0 for an integer, 1 for true. Messages are `json_reading`'s.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

from router.compiler.cdr.primitives import put_length, put_text, scalar_format
from router.gateway.invalid import InvalidMessageError, shown
from router.types.model import Bool, Float, Int, List, String

Put = Callable[[bytearray, Any], None]
"""Appends a value to a message without its header. Raises InvalidMessageError when it is none of the type."""

_CHUNK = 4096
"""Elements that one call checks or packs: other threads wait meanwhile."""
_PADDING = tuple(bytes(count) for count in range(8))


class Numbers:
    """The values of a primitive type other than text."""

    def __init__(self, declared: Bool | Int | Float) -> None:
        self._declared = declared
        self._letter = scalar_format(declared)
        self._size = struct.calcsize(self._letter)
        self._is_float = isinstance(declared, Float)
        self._pack = struct.Struct(f"<{self._letter}").pack
        match declared:
            case Bool():
                self._types, self._noun = frozenset[type]({bool}), "neither true nor false"
            case Int():
                self._types, self._noun = frozenset[type]({int}), "no integer"
            case Float():
                self._types, self._noun = frozenset[type]({int, float}), "no number"

    def put(self, data: bytearray, value: Any) -> None:
        """Appends one value."""
        if type(value) not in self._types:
            raise self._unfit(value)
        try:
            packed = self._pack(value)
        except (struct.error, OverflowError):
            raise self._unfit(value) from None
        if self._is_float and not math.isfinite(value):
            raise self._unfit(value)
        data += _PADDING[-len(data) % self._size]
        data += packed

    def put_all(self, data: bytearray, values: Sequence[Any]) -> None:
        """Appends the elements of a list, without its length."""
        if values:
            data += _PADDING[-len(data) % self._size]
        for start in range(0, len(values), _CHUNK):
            chunk = values[start : start + _CHUNK]
            if (packed := self._packed(chunk)) is None:
                raise self._first_unfit(chunk, start)
            data += packed

    def _packed(self, values: Sequence[Any]) -> bytes | None:
        """None where one does not fit."""
        if not self._types.issuperset(map(type, values)):
            return None
        try:
            packed = struct.pack(f"<{len(values)}{self._letter}", *values)
        except (struct.error, OverflowError):
            return None
        return None if self._is_float and not all(map(math.isfinite, values)) else packed

    def _first_unfit(self, values: Sequence[Any], start: int) -> InvalidMessageError:
        """Of values one of which does not fit; the first is element `start` of the list."""
        index = next(index for index, value in enumerate(values) if self._packed([value]) is None)
        return self._unfit(values[index]).inside(f"[{start + index}]")

    def _unfit(self, value: Any) -> InvalidMessageError:
        if type(value) not in self._types:
            return InvalidMessageError(f"{shown(value)} is {self._noun}")
        limits = f", {self._declared.low} to {self._declared.high}" if isinstance(self._declared, Int) else ""
        return InvalidMessageError(f"{shown(value)} is outside of {self._declared}{limits}")


_UNITS = Numbers(Int(16, signed=False))


def text_writer(declared: String, of_units: bool) -> Put:
    """With `of_units` a wstring is a list of its UTF-16 code units, as the existing gateway sends it."""
    if not declared.wide:
        return _text_writer(declared.bound)
    return _wide_text_writer(declared.bound, of_units)


def _text_writer(bound: int | None) -> Put:
    def put(data: bytearray, value: Any) -> None:
        encoded = _encoded(value, "utf-8")
        if "\0" in value:
            raise InvalidMessageError("a string of ROS holds no NUL")
        if bound is not None and len(encoded) > bound:
            raise InvalidMessageError(f"{len(encoded)} bytes are more than {bound}")
        put_text(data, value)

    return put


def _wide_text_writer(bound: int | None, of_units: bool) -> Put:
    def put(data: bytearray, value: Any) -> None:
        encoded = _encoded_units(value) if of_units else _encoded(value, "utf-16-le")
        length = len(encoded) // 2
        if bound is not None and length > bound:
            raise InvalidMessageError(f"{length} characters are more than {bound}")
        put_length(data, length, None)
        for start in range(0, length, _CHUNK):
            units = struct.unpack_from(f"<{min(_CHUNK, length - start)}H", encoded, 2 * start)
            data += struct.pack(f"<{len(units)}I", *units)  # 32 bits each, as rmw_fastrtps does it

    return put


def _encoded(value: Any, encoding: str) -> bytes:
    if type(value) is not str:
        raise InvalidMessageError(f"{shown(value)} is no string")
    try:
        return value.encode(encoding)
    except UnicodeEncodeError:
        raise InvalidMessageError("the string has half of a surrogate pair") from None


def _encoded_units(value: Any) -> bytes:
    """The text of numbers, in UTF-16."""
    if type(value) is not list:
        raise InvalidMessageError(f"{shown(value)} is no list of UTF-16 code units")
    encoded = bytearray()
    _UNITS.put_all(encoded, value)
    try:
        encoded.decode("utf-16-le")
    except UnicodeDecodeError:
        raise InvalidMessageError("the string has half of a surrogate pair") from None
    return bytes(encoded)


def put_size(data: bytearray, declared: List, values: Any) -> None:
    """Checks that a list is one and as long as declared, and appends its length where the type does not tell it."""
    if type(values) is not list:
        raise InvalidMessageError(f"{shown(values)} is no list")
    if declared.length is not None:
        if len(values) != declared.length:
            raise InvalidMessageError(f"{len(values)} elements instead of {declared.length}")
        return
    if declared.bound is not None and len(values) > declared.bound:
        raise InvalidMessageError(f"{len(values)} elements are more than {declared.bound}")
    put_length(data, len(values), None)

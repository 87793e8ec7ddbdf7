"""What generated code calls for strings and lists: JSON text from bytes that were cut out of a message.

The bytes may be anything: UnreadableError and UnicodeError are for those that mean nothing. Texts of short ones are
kept by their bytes, since most come again (frame names, covariances). Of long ones, no single call into C that holds
the interpreter's lock takes more than 4096 elements, so that a message of megabytes holds up no other thread.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import NoReturn

from router.gateway.numbers import DOUBLES, FLOATS
from router.gateway.style import UnreadableError

_MOST = 4096
"""Elements a call."""
SHORT = 320
"""Bytes of a list that is looked up as a whole: so much takes a covariance of six by six."""
_KEPT = 1024
"""Texts of a kind."""
_LARGEST_UNIT = 0xFFFF
_quote = json.JSONEncoder(ensure_ascii=False).encode
_Convert = Callable[[bytes], str]
ListText = Callable[[bytes, int, int], str]
"""Takes a message and where in it the elements begin and end; the text is without brackets."""


class KnownTexts(dict[bytes, str]):
    """Texts by their bytes, made when first asked for; forgets all when it holds many."""

    def __init__(self, convert: _Convert) -> None:
        super().__init__()
        self._convert = convert

    def __missing__(self, data: bytes) -> str:
        text = self._convert(data)
        if len(data) <= SHORT:
            if len(self) >= _KEPT:
                self.clear()
            self[data] = text
        return text


def cut_off(cdr: bytes) -> NoReturn:
    raise UnreadableError(f"the message ends after {len(cdr)} bytes, within a string or list")


def joined(texts: Sequence[str]) -> str:
    """With commas between them."""
    if len(texts) <= _MOST:
        return ",".join(texts)
    return ",".join([",".join(texts[start : start + _MOST]) for start in range(0, len(texts), _MOST)])


def _string(data: bytes) -> str:
    """A string from its bytes, which end with NUL; whoever leaves that out is understood by Fast CDR too."""
    return _quoted(data.removesuffix(b"\0").decode())


def _quoted(text: str) -> str:
    if len(text) <= _MOST:
        return _quote(text)
    return "".join(['"', *(_quote(text[start : start + _MOST])[1:-1] for start in range(0, len(text), _MOST)), '"'])


def _wide_string(data: bytes) -> str:
    """A wstring, which has its UTF-16 units in 32 bits each, as a string."""
    units = b"".join([struct.pack(f"<{len(part)}H", *part) for part in _units(data)])
    return _quoted(units.decode("utf-16-le"))


def _wide_list(data: bytes) -> str:
    """The same as a list of its units."""
    return ",".join([_plain(part) for part in _units(data)])


def _units(data: bytes) -> list[tuple[int, ...]]:
    size = 4 * _MOST
    parts = [_unpack("I", 4, data[start : start + size]) for start in range(0, len(data) & ~3, size)]
    if any(max(part) > _LARGEST_UNIT for part in parts):
        raise UnreadableError("a wstring has units that are no UTF-16")
    return parts


def _unpack(letter: str, size: int, data: bytes) -> tuple[int, ...]:
    return struct.unpack_from(f"<{len(data) // size}{letter}", data)


_FULL = ",".join(["%d"] * _MOST)


def _plain(numbers: tuple[int, ...]) -> str:
    return (_FULL if len(numbers) == _MOST else ",".join(["%d"] * len(numbers))) % numbers


def _looked_up(texts: Sequence[str]) -> _Convert:
    """For elements of one byte, of which `texts` has all 256. Nothing looks up many more quickly than an itemgetter."""

    def convert(data: bytes) -> str:
        return ",".join(itemgetter(*data)(texts)) if len(data) > 1 else "".join([texts[byte] for byte in data])

    return convert


def _doubles(data: bytes) -> str:
    return ",".join([DOUBLES[bits] for bits in _unpack("Q", 8, data)])


def _floats(data: bytes) -> str:
    return ",".join([FLOATS[bits] for bits in _unpack("I", 4, data)])


def _integers(letter: str) -> _Convert:
    size = struct.calcsize(f"<{letter}")
    return lambda data: _plain(_unpack(letter, size, data))


_CONVERT: dict[str, _Convert] = {
    "?": _looked_up(["false"] + ["true"] * 255),
    "b": _looked_up([str(byte - (byte >> 7 << 8)) for byte in range(256)]),
    "B": _looked_up([str(byte) for byte in range(256)]),
    **{letter: _integers(letter) for letter in "hHiIqQ"},
    "f": _floats,
    "d": _doubles,
}

STRINGS = KnownTexts(_string)
WIDE_STRINGS = KnownTexts(_wide_string)
WIDE_LISTS = KnownTexts(_wide_list)
SHORT_LISTS = {letter: KnownTexts(convert) for letter, convert in _CONVERT.items()}
"""By the struct letter of the elements; texts are without brackets."""


def list_text(letter: str) -> ListText:
    """For lists of scalars of any length; raises UnreadableError when they end behind the message."""
    short, convert = SHORT_LISTS[letter], _CONVERT[letter]
    size = _MOST * struct.calcsize(f"<{letter}")

    def text(cdr: bytes, start: int, end: int) -> str:
        if end > len(cdr):
            cut_off(cdr)
        if end - start <= SHORT:
            return short[cdr[start:end]]
        return ",".join([convert(cdr[at : min(at + size, end)]) for at in range(start, end, size)])

    return text

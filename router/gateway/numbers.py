"""Floating-point numbers as JSON text, looked up by their bits. Knows no messages.

A number is its bits throughout: what `struct` reads with `Q` or `I` needs no float to be made for it. Every double
that is read once is likely to be read again (constants, stuck sensors, zeros), so the newest few thousand are kept.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from router.gateway.digits import digits

_FRACTION = (1 << 52) - 1
_NOT_FINITE = 0x7FF
_SMALLEST, _LARGEST = -4, 15
"""Between which places the decimal point may be for a number to be printed without an exponent."""
_KEPT = 1 << 13

_FLOAT, _FLOAT_BITS, _DOUBLE, _DOUBLE_BITS = (struct.Struct(f"<{letter}") for letter in "fIdQ")


class Texts(dict[int, str]):
    """Texts of numbers by their bits, made when first asked for; forgets all when it holds many."""

    def __init__(self, text: Callable[[int], str]) -> None:
        super().__init__()
        self._text = text

    def __missing__(self, bits: int) -> str:
        text = self._text(bits)
        if len(self) >= _KEPT:
            self.clear()
        self[bits] = text
        return text


def double_text(bits: int) -> str:
    """The JSON text of a float64 of these 64 bits; infinities and what is no number are `null`."""
    biased, fraction = bits >> 52 & _NOT_FINITE, bits & _FRACTION
    if biased == _NOT_FINITE:
        return "null"
    sign = "-" if bits >> 63 else ""
    if not biased and not fraction:
        return f"{sign}0.0"
    number, exponent = digits(fraction, biased)
    text = str(number)
    point = len(text) + exponent
    if 0 < point <= _LARGEST:
        return f"{sign}{text[:point]}.{text[point:]}" if exponent < 0 else f"{sign}{text}{'0' * exponent}.0"
    if _SMALLEST < point <= 0:
        return f"{sign}0.{'0' * -point}{text}"
    rest = f".{text[1:]}" if len(text) > 1 else ""
    return f"{sign}{text[0]}{rest}e{point - 1:+03d}"


def float_text(bits: int) -> str:
    """The same for a float32 of these 32 bits, which is widened first: 0.1 is 0.10000000149011612."""
    return double_text(_DOUBLE_BITS.unpack(_DOUBLE.pack(*_FLOAT.unpack(_FLOAT_BITS.pack(bits))))[0])


DOUBLES = Texts(double_text)
FLOATS = Texts(float_text)

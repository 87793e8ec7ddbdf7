"""Grisu2: the decimal digits of a double as the C++ library of the existing gateway finds them. Knows no JSON.

Florian Loitsch, "Printing Floating-Point Numbers Quickly and Accurately with Integers", PLDI 2010. The number and its
two neighbours' midpoints are scaled by a power of ten, in 64 bits, rounded; the interval between the midpoints is
narrowed by what that can be wrong by; the shortest decimal in it is taken, and moved towards the number. So it is
nearly always what `repr` prints; of 1000 random doubles 3, of 1000 random float32 20 come out otherwise: longer, or
with another last digit.

Integers stand for the scaled numbers, with `scale.places` decimal places and `scale.binary` binary ones.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

_HALF = 1 << 63
_HIDDEN = 1 << 52
_FIRST_POWER, _POWER_STEP = -300, 8
_LOWEST = -60
"""Of the binary exponents that a scaled number has; the highest is -32."""
_SPREAD = 4
"""By how many units the interval is narrower than two roundings could make it, at most."""


class Scale(NamedTuple):
    """What doubles of one binary exponent are multiplied with."""

    factor: int
    """Takes a significand to the scaled number, in units of 2**-64 of what stays."""
    above: int
    """Takes that to the midpoint above it, with the rounding."""
    below: int
    """The same for the midpoint below, where the next double is as far away as the one above."""
    ten: int
    """10**places: so many that the last one is smaller than the interval."""
    binary: int
    exponent: int
    """Power of ten that the last place stands for."""
    places: int


def power(exponent: int) -> tuple[int, int, int]:
    """For a 64-bit number times 2**exponent: the significand, binary and decimal exponent of a power of ten.

    Their product has a binary exponent, counted for its upper 64 bits, from -60 to -32.
    """
    wanted = _LOWEST - 1 - exponent
    least = int(wanted * 78913 / (1 << 18)) + (wanted > 0)  # towards zero; 78913 / 2**18 is log10(2)
    decimal = _FIRST_POWER + (least - _FIRST_POWER + _POWER_STEP - 1) // _POWER_STEP * _POWER_STEP
    numerator, denominator = (10**decimal, 1) if decimal >= 0 else (1, 10**-decimal)
    binary = numerator.bit_length() - denominator.bit_length() - 64
    while True:
        over, under = (numerator << max(0, -binary)), (denominator << max(0, binary))
        significand = (2 * over + under) // (2 * under)
        if significand.bit_length() <= 64:
            return significand, binary, decimal
        binary += 1


@cache
def scale(exponent: int, size: int) -> Scale:
    """For significands of `size` bits times 2**exponent."""
    shift = 64 - size
    significand, binary, decimal = power(exponent - shift)
    point = -(exponent - shift + binary + 64)
    half = significand << (shift - 1)
    narrowest, places = max(1, (half + half // 2 >> 64) - _SPREAD), 0
    while narrowest * 10**places < 1 << point:
        places += 1
    return Scale(significand << shift, _HALF + half, _HALF - half, 10**places, point, -decimal - places, places)


class _Scales(dict[int, Scale]):
    """By the double's 11 bits of exponent; for all significands of 53 bits."""

    def __missing__(self, biased: int) -> Scale:
        self[biased] = made = scale(biased - 1075, 53)
        return made


_SCALES = _Scales()


def digits(fraction: int, biased: int) -> tuple[int, int]:
    """Decimal digits and the power of ten that the last of them stands for.

    `fraction` and `biased` are the double's 52 and 11 bits; it is positive and finite.
    """
    if not biased or not fraction:
        return _unusual(fraction, biased)
    factor, above, below, ten, binary, exponent, _ = _SCALES[biased]
    number = (fraction | _HIDDEN) * factor
    high = (number + above >> 64) - 1
    width = (high - (number + below >> 64) - 1) * ten
    scaled = high * ten
    found = scaled >> binary
    rest = scaled - (found << binary)
    last = found % 100
    if rest + (last << binary) <= width:
        # The interval is narrower than 100, so this is the only such decimal in it: it ends in all zeros there are.
        return _without_zeros(found // 100, exponent + 2)
    unit = 1 << binary
    last = last % 10 << binary
    if rest + last <= width:
        found, rest, unit, exponent = found // 10, rest + last, unit * 10, exponent + 1
    return _nearer(found, rest, (high - (number + _HALF >> 64)) * ten, width, unit), exponent


def _without_zeros(number: int, exponent: int) -> tuple[int, int]:
    while not number % 10:
        number //= 10
        exponent += 1
    return number, exponent


def _nearer(found: int, rest: int, distance: int, width: int, unit: int) -> int:
    """Counts the last digit down while that stays in the interval and brings it closer to the number.

    All are counted from the interval's upper end: `rest` down to what was found, `distance` to the number.
    """
    while (
        rest < distance
        and width - rest >= unit
        and (rest + unit < distance or distance - rest > rest + unit - distance)
    ):
        found -= 1
        rest += unit
    return found


def _unusual(fraction: int, biased: int) -> tuple[int, int]:
    """Powers of two, which have a closer neighbour below, and numbers of fewer bits: all without short cuts."""
    significand, exponent = (fraction | _HIDDEN, biased - 1075) if biased else (fraction, -1074)
    factor, above, below, _, binary, last, places = scale(exponent, significand.bit_length())
    if not fraction and biased > 1:
        below = (_HALF + below) // 2  # a quarter of the distance between doubles, not half
    number = significand * factor
    high = (number + above >> 64) - 1
    width = high - (number + below >> 64) - 1
    distance = high - (number + _HALF >> 64)
    ten, last, more = 10**17, last + places - 17, 27
    while True:
        unit = 10**more << binary
        found, rest = divmod(high * ten, unit)
        if rest <= width * ten:
            return _nearer(found, rest, distance * ten, width * ten, unit), last + more
        more -= 1

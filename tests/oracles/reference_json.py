"""An oracle for the tests: a message's value as JSON text, one value after the other. Never used to run a gateway.

Takes values as `compiler.reference_cdr` does: dictionaries, lists and scalars. Shares no code with `json_code`, and
finds the digits of numbers by Grisu2 as its paper writes it down, digit after digit in units of 64 bits.
"""

from __future__ import annotations

import math
import struct
from fractions import Fraction
from functools import cache
from typing import Any

from router.types.model import Bool, Float, Int, List, MessageType, String, Type

_ESCAPES = {'"': '\\"', "\\": "\\\\", "\b": "\\b", "\f": "\\f", "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def reference_text(message: MessageType, value: dict[str, Any], *, is_wrapped: bool) -> str:
    """The text of a message, in the existing gateway's style or bare; ValueError for text that is no Unicode."""
    members = {field.name: _member(field.type, value[field.name], is_wrapped) for field in message.fields}
    if not members:
        members["structure_needs_at_least_one_member"] = "[0]" if is_wrapped else "0"
    return "{" + ",".join(f'"{name}":{members[name]}' for name in sorted(members)) + "}"


def _member(declared: Type, value: Any, is_wrapped: bool) -> str:
    if isinstance(declared, List):
        return "[" + ",".join(_bare(declared.element, element, is_wrapped) for element in value) + "]"
    bare = _bare(declared, value, is_wrapped)
    return f"[{bare}]" if is_wrapped else bare


def _bare(declared: Type, value: Any, is_wrapped: bool) -> str:
    match declared:
        case MessageType():
            return reference_text(declared, value, is_wrapped=is_wrapped)
        case String(wide=True) if is_wrapped:
            units = value.encode("utf-16-le", "surrogatepass")
            return "[" + ",".join(str(unit) for (unit,) in struct.iter_unpack("<H", units)) + "]"
        case String():
            value.encode()  # which refuses surrogates
            return '"' + "".join(map(_escaped, value)) + '"'
        case Bool():
            return "true" if value else "false"
        case Int():
            return str(int(value))
        case Float():
            return reference_number(float(value))
        case _:
            raise TypeError(f"ROS has no type {declared}")


def _escaped(character: str) -> str:
    return _ESCAPES.get(character) or (character if character >= " " else f"\\u{ord(character):04x}")


def reference_number(value: float) -> str:
    if not math.isfinite(value):
        return "null"
    if value == 0 or math.copysign(1, value) < 0:
        return "0.0" if str(value) == "0.0" else "-" + reference_number(-value)
    digits, exponent = _grisu(value)
    point = len(digits) + exponent
    if point > 15 or point <= -4:
        return f"{digits[0]}{'.' * (len(digits) > 1)}{digits[1:]}e{'-' if point < 1 else '+'}{abs(point - 1):02d}"
    if point <= 0:
        return "0." + "0" * -point + digits
    return digits[:point].ljust(point, "0") + "." + (digits[point:] or "0")


def _grisu(value: float) -> tuple[str, int]:
    """Decimal digits of a positive number, and the power of ten of the last one."""
    two = math.frexp(value)[1] - 64
    number, above = Fraction(value), Fraction(math.ulp(value)) / 2
    below = (number - Fraction(math.nextafter(value, 0))) / 2
    power, power_two, power_ten = _cached_power(two)
    scaled, high, low = (
        math.floor(it / Fraction(2) ** two * power / 2**64 + Fraction(1, 2))
        for it in (number, number + above, number - below)
    )
    return _digits(scaled, high - 1, low + 1, -(two + power_two + 64), -power_ten)


@cache
def _cached_power(two: int) -> tuple[int, int, int]:
    """The first power 10**(8i - 300), as 64 bits and a binary exponent, that brings `two` up to -60 or more."""
    return next(power for power in _powers() if two + power[1] + 64 >= -60)


@cache
def _powers() -> list[tuple[int, int, int]]:
    found = []
    for ten in range(-300, 332, 8):
        power, binary = Fraction(10) ** ten, 0
        while power >= 2**64:
            power, binary = power / 2, binary + 1
        while power < 2**63:
            power, binary = power * 2, binary - 1
        found.append((round(power), binary, ten))
    return found


def _digits(scaled: int, high: int, low: int, point: int, exponent: int) -> tuple[str, int]:
    """Digits of `high`, `point` binary places, until what is left of it is within the interval; then closer."""
    whole = str(high >> point)
    unit = Fraction(10) ** (len(whole) - 1) * 2**point
    digits, rest = 0, Fraction(high)
    while True:
        digit = rest // unit
        digits, rest = digits * 10 + digit, rest - digit * unit
        if rest <= high - low:
            break
        unit /= 10
    distance = high - scaled
    while rest < distance and high - low - rest >= unit and (
        rest + unit < distance or distance - rest > rest + unit - distance
    ):  # fmt: skip
        digits, rest = digits - 1, rest + unit
    return str(digits), exponent + round(math.log10(unit / 2**point))

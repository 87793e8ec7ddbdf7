"""The names that generated code in Python can call.

A value that a field cannot hold raises MappingError.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Mapping, Sequence, Sized
from typing import TypeVar

from router.compiler.cdr.primitives import (
    CDR_LE,
    HEADER,
    put_length,
    put_numbers,
    put_text,
    put_wide_text,
    want_length,
)
from router.compiler.expressions.functions import FUNCTIONS
from router.errors import MappingError
from router.types.framing import trimmed

MAPPING_FAILURES = (ArithmeticError, ValueError, LookupError, struct.error, MappingError)
"""What a value in a message can make a mapping raise. Any other exception is a bug of the router and propagates."""

Values = TypeVar("Values", bound=Sized)


# checks of values that are read, or fill fields; tables cannot call these


def checked_text(x: str | bytes) -> str:
    """Return text that protobuf did not check: it gives bytes where they are no UTF-8."""
    if isinstance(x, str):
        return x
    raise MappingError(f"{x!r} is no text")


def checked_texts(values: Sequence[str | bytes]) -> Sequence[str]:
    """Return a list of such texts."""
    return [checked_text(value) for value in values]


def fit(x: int, low: int, high: int) -> int:
    """Return an integer between `low` and `high`."""
    if low <= x <= high:
        return x
    raise MappingError(f"{x} is outside {low}..{high}")


def fit_text(x: str | bytes, bound: int) -> str | bytes:
    """Return text or bytes of at most `bound` bytes."""
    length = len(x.encode() if isinstance(x, str) else x)
    if length <= bound:
        return x
    raise MappingError(f"{length} bytes are more than {bound}")


def fit_length(values: Values, least: int, most: int) -> Values:
    """Return a list of `least` to `most` elements."""
    if least <= len(values) <= most:
        return values
    wanted = str(most) if least == most else f"at most {most}"
    raise MappingError(f"{len(values)} elements where {wanted} fit")


def named(name: str, values: Mapping[str, int]) -> int:
    """Return the value of an enum that has this name."""
    if name in values:
        return values[name]
    raise MappingError(f"no value is called {name!r}")


def member(x: int, values: Collection[int]) -> int:
    """Return a number that is a value of a closed enum."""
    if x in values:
        return x
    raise MappingError(f"{x} is no value of the enum")


def octets(values: Iterable[int]) -> bytes:
    """Return integers as bytes. Raises ValueError for one outside of 0 to 255."""
    return bytes(values)


# lists


def side_by_side(*lists: Sequence[object]) -> list[tuple[object, ...]]:
    """Return the first elements of all lists, the second ones, and so on."""
    if len({len(each) for each in lists}) > 1:
        raise MappingError(f"lists of {' and '.join(str(len(each)) for each in lists)} elements, side by side")
    return list(zip(*lists, strict=True))


def contains(sought: object, values: Iterable[object]) -> bool:
    """Return whether a value equals one of a list; NaN equals nothing."""
    return any(value == sought for value in values)


def total(values: Iterable[float]) -> float:
    """Return the sum of floats, added one after the other."""
    result = 0.0
    for value in values:
        result += value
    return result


def whole_total(values: Iterable[int], low: int, high: int) -> int:
    """Return the sum of integers. No sum on the way may be outside of `low` to `high`."""
    result = 0
    for value in values:
        result = fit(result + value, low, high)
    return result


_CALLED = (
    checked_text, checked_texts, fit, fit_length, fit_text, named, member, octets,
    side_by_side, contains, total, whole_total,
    put_text, put_wide_text, put_numbers, put_length, want_length,
)  # fmt: skip
NAMESPACE: Mapping[str, object] = {
    **{name: function.implementation for name, function in FUNCTIONS.items()},
    **{function.__name__: function for function in _CALLED},
    "HEADER": HEADER,
    "CDR_LE": CDR_LE,
    "trimmed": trimmed,
}

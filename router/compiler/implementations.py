"""What the functions of the expression language do to values at run time, and what else generated code asks of a value.

Called with plain Python values; knows neither kinds nor syntax. A value without a result raises MappingError.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sized
from typing import Any, NamedTuple, TypeVar

from router.errors import MappingError, NonFiniteError

Values = TypeVar("Values", bound=Sized)

NS_PER_SECOND = 1_000_000_000
NS_PER_MILLISECOND = 1_000_000
FLOAT32_END = 3.4028235677973366e38
"""The smallest magnitude that does not round to a finite float32."""

# functions of the language


def round_half_even(x: float) -> int:
    return _to_int(round, x)


def truncate(x: float) -> int:
    return _to_int(math.trunc, x)


def floor(x: float) -> int:
    return _to_int(math.floor, x)


def ceil(x: float) -> int:
    return _to_int(math.ceil, x)


def _to_int(convert: Callable[[float], int], x: float) -> int:
    try:
        return convert(x)
    except (ValueError, OverflowError):
        raise NonFiniteError(f"{x} is no integer") from None


def clamp(x: float, low: float, high: float) -> float:
    return low if x < low else high if x > high else x  # noqa: FURB136 - min() takes three times as long


def wrap(x: int, low: int, high: int) -> int:
    return (x - low) % (high - low + 1) + low


def to_float32(x: float) -> float:
    if math.isinf(x) or abs(x) < FLOAT32_END or math.isnan(x):
        return x
    raise MappingError(f"{x} is too large for a float32")


def seconds(time: int) -> float:
    return time / NS_PER_SECOND


def time_from_seconds(x: float) -> int:
    return _to_int(round, x * NS_PER_SECOND)


def time_from_milliseconds(x: float) -> int:
    return _to_int(round, x * NS_PER_MILLISECOND)


# what fields are read through


class Entry(NamedTuple):
    """One entry of a protobuf map, with the names that its declaration gives both parts."""

    key: Any
    value: Any


def entries(values: Mapping[Any, object]) -> tuple[Entry, ...]:
    """A protobuf map as the list that it is on the wire, in the order of its keys: its own differs from run to run."""
    return tuple(Entry(key, values[key]) for key in sorted(values))


# what fields ask of the values that fill them; tables cannot call these


def fit(x: int, low: int, high: int) -> int:
    """Passes an integer that the target can hold."""
    if low <= x <= high:
        return x
    raise MappingError(f"{x} is outside {low}..{high}")


def fit_text(x: str | bytes, bound: int) -> str | bytes:
    """Passes text or bytes of at most `bound` bytes."""
    length = len(x.encode() if isinstance(x, str) else x)
    if length <= bound:
        return x
    raise MappingError(f"{length} bytes are more than {bound}")


def fit_wide_text(x: str, bound: int) -> str:
    """Passes text of at most `bound` UTF-16 code units."""
    length = len(x.encode("utf-16-le")) // 2
    if length <= bound:
        return x
    raise MappingError(f"{length} characters are more than {bound}")


def fit_length(values: Values, least: int, most: int) -> Values:
    """Passes a list of `least` to `most` elements."""
    if least <= len(values) <= most:
        return values
    wanted = str(most) if least == most else f"at most {most}"
    raise MappingError(f"{len(values)} elements where {wanted} fit")

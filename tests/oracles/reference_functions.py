"""The oracle's operators and functions, one rule for each in docs/reference/table.md and functions.md.

A rule takes the kinds and constants of the operands, and returns the kind of the result and a function that computes
it. Rules do not handle lists: `reference_expressions` applies them to each element.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

from tests.oracles.reference_kinds import (
    MAPPING_ERROR,
    NON_FINITE,
    NS,
    SIGNED,
    UNSIGNED,
    Kind,
    Listing,
    Real,
    Refused,
    Text,
    Time,
    Truth,
    Whole,
    number,
    shaped,
    whole,
)

Compute = Callable[..., Any]
Rule = Callable[[Sequence[Kind], Sequence[Any]], "tuple[Kind, Compute]"]


def _always(kind: Kind, compute: Compute) -> Rule:
    return lambda _kinds, _constants: (kind, compute)


def _bounds(kind: Kind) -> tuple[int, int]:
    made = number(kind)
    assert isinstance(made, Whole)
    return made.low, made.high


def _are_wholes(kinds: Sequence[Kind]) -> bool:
    return all(isinstance(number(kind), Whole) for kind in kinds)


def _alike(kinds: Sequence[Kind], compute: Compute) -> Compute:
    """Compute with integers, or with doubles if one of them is a float."""
    convert: Callable[[Any], Any] = int if _are_wholes(kinds) else float
    return lambda *values: compute(*map(convert, values))


# operators


def _add(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    if all(isinstance(kind, Text) for kind in kinds):
        return Text(), operator.add
    return _sum_or_product(operator.add)(kinds, constants)


def _sum_or_product(compute: Compute) -> Rule:
    def rule(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
        if not _are_wholes(kinds):
            return Real(), _alike(kinds, compute)
        left, right = map(_bounds, kinds)
        return whole(compute(x, y) for x in left for y in right), _alike(kinds, compute)

    return rule


def _divide(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    return Real(), lambda x, y: _divided(operator.truediv, float(x), float(y))


def _floor_divide(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    compute = _alike(kinds, lambda x, y: _divided(operator.floordiv, x, y))
    if not _are_wholes(kinds):
        return Real(), compute
    left, (low, high) = map(_bounds, kinds)
    divisors = [y for y in (low, -1, 1, high) if low <= y <= high and y != 0]
    return whole(x // y for x in left for y in divisors), compute


def _modulo(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    compute = _alike(kinds, lambda x, y: _divided(operator.mod, x, y))
    if not _are_wholes(kinds):
        return Real(), compute
    low, high = _bounds(kinds[1])
    return whole([min(low + 1, 0), max(high - 1, 0)]), compute


def _divided(compute: Compute, x: Any, y: Any) -> Any:
    if y == 0:
        raise Refused(MAPPING_ERROR)
    return compute(x, y)


def _power(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    exponent = constants[1]
    if not _are_wholes(kinds[:1]):
        return Real(), lambda x, _: _finite(operator.pow, float(x), exponent)
    low, high = _bounds(kinds[0])
    extremes = [low**exponent, high**exponent, *[0] * (low < 0 < high)]
    return whole(extremes), lambda x, _: int(x) ** exponent


def _finite(compute: Compute, *values: Any) -> Any:
    """The result of a computation. Raises Refused if there is none, or if finite operands give infinity."""
    try:
        return compute(*values)
    except (OverflowError, ValueError):
        raise Refused(MAPPING_ERROR) from None


def negate(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    if not _are_wholes(kinds):
        return Real(), operator.neg
    low, high = _bounds(kinds[0])
    return whole([-high, -low]), lambda x: -int(x)


def same_number(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    """The rule of `+x`."""
    return number(kinds[0]), lambda x: x


OPERATORS: dict[str, Rule] = {
    "+": _add,
    "-": _sum_or_product(operator.sub),
    "*": _sum_or_product(operator.mul),
    "/": _divide,
    "//": _floor_divide,
    "%": _modulo,
    "**": _power,
}


# functions of scalars


def _absolute(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    if not _are_wholes(kinds):
        return Real(), abs
    low, high = _bounds(kinds[0])
    return whole([abs(low), abs(high), *[0] * (low < 0 < high)]), lambda x: abs(int(x))


def _rounded(compute: Callable[[float], int]) -> Rule:
    def rule(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
        kind = number(kinds[0])
        if isinstance(kind, Whole):
            return kind, int
        limits = SIGNED
        if kind.low is not None and kind.high is not None and math.isfinite(kind.low) and math.isfinite(kind.high):
            limits = Whole(*(max(min(compute(each), SIGNED.high), SIGNED.low) for each in (kind.low, kind.high)))
        return limits, lambda x: _to_whole(compute, x)

    return rule


def _to_whole(compute: Callable[[float], int], x: float) -> int:
    if not math.isfinite(x):
        raise Refused(NON_FINITE)
    return compute(x)


def _extreme(is_better: Callable[[Any, Any], bool], pick: Callable[[list[int]], int]) -> Rule:
    """The rule of min() and max() with several arguments."""

    def rule(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
        compute = _alike(kinds, lambda *values: best(values, is_better))
        if not _are_wholes(kinds):
            return Real(), compute
        bounds = [*map(_bounds, kinds)]
        return whole([pick([low for low, _ in bounds]), pick([high for _, high in bounds])]), compute

    return rule


def best(values: Sequence[Any], is_better: Callable[[Any, Any], bool]) -> Any:
    """The first value, unless a later one is better."""
    chosen = values[0]
    for value in values[1:]:
        if is_better(value, chosen):
            chosen = value
    return chosen


def _clamp(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    compute = _alike(kinds, _clamped)
    if _are_wholes(kinds):
        _, low, high = map(_bounds, kinds)
        return whole([min(low[0], high[0]), max(low[1], high[1])]), compute
    if constants[1] is None or constants[2] is None:
        return Real(), compute
    return Real(float(constants[1]), float(constants[2])), compute


def _clamped(x: Any, low: Any, high: Any) -> Any:
    if x < low:
        return low
    return high if x > high else x  # noqa: FURB136 - min() differs where x is NaN


def _wrap(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    def compute(x: int, low: int, high: int) -> int:
        if low > high:
            raise Refused(MAPPING_ERROR)
        return (x - low) % (high - low + 1) + low

    _, low, high = map(_bounds, kinds)
    return whole([low[0], high[1]]), compute


def _float32(x: float) -> float:
    if math.isfinite(x) and abs(x) >= 3.4028235677973366e38:  # rounds to infinity
        raise Refused(MAPPING_ERROR)
    return float(x)


def _text(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    return Text(), lambda x, digits: f"{float(x):.{digits}f}"


def _strip(x: str) -> str:
    padding = " \t\n\v\f\r\0"
    while x and x[-1] in padding:
        x = x[:-1]
    while x and x[0] in padding:
        x = x[1:]
    return x


def _int(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    return (Whole(0, 1) if isinstance(kinds[0], Truth) else number(kinds[0])), int


def _str(kinds: Sequence[Kind], constants: Sequence[Any]) -> tuple[Kind, Compute]:
    if isinstance(kinds[0], (Text, Truth)):
        return Text(), str
    return Text(), lambda x: str(int(x))


def _time(scale: int) -> Rule:
    def compute(x: float) -> int:
        return _to_whole(round, x * scale)

    return _always(Time(), lambda x: _within_64_bits(compute(x)))


def _within_64_bits(time: int) -> int:
    return shaped(time, SIGNED)  # type: ignore[no-any-return]


def _real(compute: Callable[..., float]) -> Rule:
    return _always(Real(), lambda *values: _finite(compute, *map(float, values)))


FUNCTIONS: dict[str, Rule] = {
    "abs": _absolute,
    "min": _extreme(operator.lt, min),
    "max": _extreme(operator.gt, max),
    "round": _rounded(round),
    "trunc": _rounded(math.trunc),
    "floor": _rounded(math.floor),
    "ceil": _rounded(math.ceil),
    "clamp": _clamp,
    "wrap": _wrap,
    "radians": _real(math.radians),
    "degrees": _real(math.degrees),
    "sqrt": _real(math.sqrt),
    "sin": _real(math.sin),
    "cos": _real(math.cos),
    "tan": _real(math.tan),
    "atan2": _real(math.atan2),
    "hypot": _real(math.hypot),
    "float32": _real(_float32),
    "float64": _real(float),
    "int": _int,
    "str": _str,
    "strip": _always(Text(), _strip),
    "text": _text,
    "len": _always(Whole(0, (1 << 32) - 1), len),
    "seconds": _real(lambda time: time / NS),
    "time_from_seconds": _time(NS),
    "time_from_milliseconds": _time(1_000_000),
}


# functions of a whole list


def extreme_of(name: str, values: Sequence[Any]) -> Any:
    """The rule of min(list) and max(list)."""
    if not values:
        raise Refused(MAPPING_ERROR)
    return best(values, operator.lt if name == "min" else operator.gt)


def kind_of_sum(kind: Listing) -> Kind:
    element = number(kind.element) if kind.element is not None else Whole(0, 0)
    if isinstance(element, Real):
        return Real()
    if kind.length is None:
        return SIGNED if element.low < 0 else UNSIGNED
    return whole([kind.length * element.low, kind.length * element.high])


def sum_of(values: Sequence[Any], kind: Kind) -> Any:
    """The rule of sum(list): adds in order; each partial sum has to fit the 64 bits of the result."""
    if isinstance(kind, Real):
        return sum_in_order(values, 0.0, kind)
    assert isinstance(kind, Whole)
    return sum_in_order(values, 0, SIGNED if kind.low < 0 else UNSIGNED)


def sum_in_order(values: Sequence[Any], total: Any, limits: Kind) -> Any:
    for value in values:
        total = shaped(total + value, limits)
    return total

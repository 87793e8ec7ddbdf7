"""The functions of the expression language: each declared once, with documentation, examples and implementation.

The examples are tests (tests/compiler/test_expressions.py) and the reference page is generated from them. Each function
has a rule that gives the kind of a call from the kinds of its arguments, in order, once their number and kinds are
checked; it raises ValueError with a sentence when no call with such arguments works. An implementation raises
MappingError for a value without a result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.expressions.kinds import (
    ANY_INT,
    BoolKind,
    BytesKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    Number,
    StringKind,
    TimeKind,
    as_int,
    float_bits,
    join,
)
from router.errors import MappingError, NonFiniteError

NS_PER_SECOND = 1_000_000_000
NS_PER_MILLISECOND = 1_000_000
FLOAT32_END = 3.4028235677973366e38
"""The smallest magnitude that does not round to a finite float32."""

INT64_END = 1 << 63
"""The first integer that does not fit 64 bits with a sign."""

# implementations


def round_half_even(x: float) -> int:
    return _to_int(round, x)


def truncate(x: float) -> int:
    return _to_int(math.trunc, x)


def floor(x: float) -> int:
    return _to_int(math.floor, x)


def ceil(x: float) -> int:
    return _to_int(math.ceil, x)


def _to_int(convert: Callable[[float], int], x: float) -> int:
    if isinstance(x, int):
        return x
    if not math.isfinite(x):
        raise NonFiniteError(f"{x} is no integer")
    return _within_64_bits(convert(x))


def _within_64_bits(x: int) -> int:
    if -INT64_END <= x < INT64_END:
        return x
    raise MappingError(f"{x} does not fit 64 bits")


def clamp(x: float, low: float, high: float) -> float:
    return low if x < low else high if x > high else x  # noqa: FURB136 - min() takes three times as long


def wrap(x: int, low: int, high: int) -> int:
    if low > high:
        raise MappingError(f"the low bound {low} is above the high bound {high}")
    return (x - low) % (high - low + 1) + low


def atan2(y: float, x: float) -> float:
    return _with_one_nan(math.atan2(y, x))


def hypot(x: float, y: float) -> float:
    return _with_one_nan(math.hypot(x, y))


def _with_one_nan(x: float) -> float:
    """Python 3.10 makes a NaN of its own from any, with the sign that the processor gives it."""
    return math.nan if x != x else x  # noqa: PLR0124 - NaN alone differs from itself


def to_float32(x: float) -> float:
    if math.isinf(x) or abs(x) < FLOAT32_END or math.isnan(x):
        return float(x)
    raise MappingError(f"{x} is too large for a float32")


def seconds(time: int) -> float:
    return float(time) / NS_PER_SECOND


def time_from_seconds(x: float) -> int:
    return _within_64_bits(_to_int(round, x * NS_PER_SECOND))


def time_from_milliseconds(x: float) -> int:
    return _within_64_bits(_to_int(round, x * NS_PER_MILLISECOND))


def fixed(x: float, digits: int) -> str:
    return f"{float(x):.{digits}f}"


# kinds of results

Rule = Callable[[Sequence[Kind]], Kind]
"""Gives the kind of a call from the kinds of its arguments."""


def _always(kind: Kind) -> Rule:
    return lambda _: kind


def _common(kinds: Sequence[Kind]) -> Kind:
    """The kind that holds all arguments."""
    joined = kinds[0]
    for kind in kinds[1:]:
        joined = join(joined, kind) or joined
    return joined


def _double(kinds: Sequence[Kind]) -> Kind:
    return FloatKind(max(map(float_bits, kinds)))


def _integer(kinds: Sequence[Kind]) -> Kind:
    """The same integer, or one of unknown range for a float."""
    return as_int(kinds[0]) or ANY_INT


def _integer_or_bool(kinds: Sequence[Kind]) -> Kind:
    return IntKind(0, 1) if isinstance(kinds[0], BoolKind) else _integer(kinds)


def _absolute(kinds: Sequence[Kind]) -> Kind:
    bounds = _bounds(kinds[0])
    if bounds is None:
        return kinds[0]
    low, high = bounds
    magnitudes = (abs(low), abs(high))
    return IntKind(0 if low <= 0 <= high else min(magnitudes), max(magnitudes))


def _extreme(pick: Callable[[list[int]], int]) -> Rule:
    """For min() and max(): from the picked low bound to the picked high bound."""

    def result(kinds: Sequence[Kind]) -> Kind:
        known = [bounds for kind in kinds if (bounds := _bounds(kind))]
        if len(known) != len(kinds):
            return _common(kinds)
        return IntKind(pick([low for low, _ in known]), pick([high for _, high in known]))

    return result


def _clamped(kinds: Sequence[Kind]) -> Kind:
    low, high = _bounds(kinds[1]), _bounds(kinds[2])
    if low and high:
        _want_ordered(low[0], high[1])
    if any(as_int(kind) is None for kind in kinds):
        return _common(kinds)
    if low is None or high is None:
        return ANY_INT
    return IntKind(min(low[0], high[0]), max(low[1], high[1]))


def _wrapped(kinds: Sequence[Kind]) -> Kind:
    low, high = _bounds(kinds[1]), _bounds(kinds[2])
    if low is None or high is None:
        return ANY_INT
    _want_ordered(low[0], high[1])
    # If the bounds may be the wrong way round, the range is known at run time only.
    return IntKind(low[0], high[1]) if low[1] <= high[0] else ANY_INT


def _bounds(kind: Kind) -> tuple[int, int] | None:
    number = as_int(kind)
    return number.bounds if number else None


def _want_ordered(low: int, high: int) -> None:
    if low > high:
        raise ValueError(f"the low bound {low} is above the high bound {high}")


# declarations


@dataclass(frozen=True, slots=True)
class Parameter:
    """`accepts` are the kinds that may be passed, `wanted` how a finding calls them."""

    name: str
    accepts: tuple[type, ...]
    wanted: str


@dataclass(frozen=True, slots=True)
class Function:
    """One function. `result` tells the kind of a call from the kinds of its arguments.

    The last parameter may be repeated when `variadic`; `optional` of the last ones may be left out.
    A function with optional bounds takes them from the integer field that it fills (see expressions). One that
    `gives_an_argument` gives a float if one of them may be one.
    """

    name: str
    parameters: tuple[Parameter, ...]
    result: Rule
    implementation: Callable[..., object]
    summary: str
    examples: tuple[tuple[str, object], ...]
    variadic: bool = False
    optional: int = 0
    gives_an_argument: bool = False

    @property
    def signature(self) -> str:
        """A call with all arguments: `clamp(x, low, high)`."""
        names = [parameter.name for parameter in self.parameters] + ["..."] * self.variadic
        return f"{self.name}({', '.join(names)})"


def _number(name: str = "x") -> Parameter:
    return Parameter(name, Number, "a number")


def _whole(name: str = "x") -> Parameter:
    return Parameter(name, (IntKind, EnumKind), "an integer")


def _real(
    implementation: Callable[..., float], summary: str, *examples: tuple[str, object], names: tuple[str, ...] = ("x",)
) -> Function:
    return Function(implementation.__name__, tuple(map(_number, names)), _double, implementation, summary, examples)


_SIZED = (StringKind, BytesKind, ListKind)
_DECLARED = (
    Function("abs", (_number(),), _absolute, abs, "The magnitude of a number.", (("abs(-3)", 3),)),
    Function("min", (_number("a"), _number("b")), _extreme(min), min, "The smallest argument.",
             (("min(2, 1.5)", 1.5),), variadic=True, gives_an_argument=True),
    Function("max", (_number("a"), _number("b")), _extreme(max), max, "The largest argument.",
             (("max(2, 3, 1)", 3),), variadic=True, gives_an_argument=True),
    Function("round", (_number(),), _integer, round_half_even,
             "The nearest integer, the even one of two. NaN and infinities drop the target.",
             (("round(2.6)", 3), ("round(2.5)", 2), ("round(-0.5)", 0))),
    Function("trunc", (_number(),), _integer, truncate, "The integer towards zero.", (("trunc(-2.7)", -2),)),
    Function("floor", (_number(),), _integer, floor, "The integer at or below.", (("floor(-2.5)", -3),)),
    Function("ceil", (_number(),), _integer, ceil, "The integer at or above.", (("ceil(2.1)", 3),)),
    Function("clamp", (_number(), _number("low"), _number("high")), _clamped, clamp,
             "The number, held between two bounds; without bounds, those of the integer field that it fills.",
             (("clamp(300, 0, 255)", 255), ("clamp(-1.5, -1.0, 1.0)", -1.0)), optional=2, gives_an_argument=True),
    Function("wrap", (_whole(), _whole("low"), _whole("high")), _wrapped, wrap,
             "The integer, counted on from the low bound when it passes the high one; without bounds, those of "
             "the integer field that it fills.",
             (("wrap(256, 0, 255)", 0), ("wrap(-1, 0, 255)", 255), ("wrap(190, -180, 179)", -170)), optional=2),
    _real(math.radians, "Degrees to radians.", ("radians(180)", math.pi)),
    _real(math.degrees, "Radians to degrees.", ("degrees(0.0)", 0.0)),
    _real(math.sqrt, "The square root; of a negative number there is none, and the target is dropped.",
          ("sqrt(9)", 3.0)),
    _real(math.sin, "The sine of an angle in radians.", ("sin(0)", 0.0)),
    _real(math.cos, "The cosine of an angle in radians.", ("cos(0)", 1.0)),
    _real(math.tan, "The tangent of an angle in radians.", ("tan(0)", 0.0)),
    _real(atan2, "The angle of the point (x, y) in radians, -pi to pi.", ("atan2(0, 1)", 0.0),
          names=("y", "x")),
    _real(hypot, "The length of the vector (x, y).", ("hypot(3, 4)", 5.0), names=("x", "y")),
    Function("float32", (_number(),), _always(FloatKind(32)), to_float32,
             "Says that a double, or a large integer, may lose digits in a float32.", (("float32(0.5)", 0.5),)),
    Function("float64", (_number(),), _always(FloatKind(64)), float,
             "Says that a large integer may lose digits in a double.", (("float64(3)", 3.0),)),
    Function("int", (Parameter("x", (BoolKind, IntKind, EnumKind), "a bool, an integer or an enum"),),
             _integer_or_bool, int, "A bool as 0 or 1, an enum as its number.", (("int(True)", 1),)),
    Function("str", (Parameter("x", (BoolKind, IntKind, FloatKind, EnumKind, StringKind), "a scalar"),),
             _always(StringKind()), str, "A scalar as text.", (("'wheel_' + str(3)", "wheel_3"),)),
    Function("len", (Parameter("x", _SIZED, "a list, a string or bytes"),), _always(IntKind(0, (1 << 32) - 1)),
             len, "How many elements a list has, or characters a string.", (("len([1, 2])", 2),)),
    Function("seconds", (Parameter("time", (TimeKind,), "a time"),), _always(FloatKind(64)), seconds,
             "A time as seconds since 1970.", (("seconds(time_from_seconds(1.5))", 1.5),)),
    Function("time_from_seconds", (_number(),), _always(TimeKind()), time_from_seconds,
             "Seconds since 1970 as a time, which has 64 bits in nanoseconds.",
             (("time_from_seconds(2)", 2_000_000_000),)),
    Function("time_from_milliseconds", (_number(),), _always(TimeKind()), time_from_milliseconds,
             "Milliseconds since 1970 as a time, likewise.",
             (("time_from_milliseconds(1500)", 1_500_000_000),)),
)  # fmt: skip

FUNCTIONS: Mapping[str, Function] = {function.name: function for function in _DECLARED}
"""By name, without `has`."""

NOT_FINITE: Mapping[str, float] = {"nan": math.nan, "inf": math.inf}
"""Values without literals, by name; a field of that name wins."""

HAS = "has"
"""`has(field)` takes a field instead of its value, so it is part of the syntax."""

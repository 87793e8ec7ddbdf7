"""The functions of the expression language: each declared once, with its documentation and examples.

The examples are tests (tests/compiler/test_functions.py) and the reference page is generated from them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from router.compiler import function_kinds as result
from router.compiler.function_kinds import Rule
from router.compiler.implementations import (
    ceil,
    clamp,
    floor,
    round_half_even,
    seconds,
    time_from_milliseconds,
    time_from_seconds,
    to_float32,
    truncate,
    wrap,
)
from router.compiler.kinds import (
    BoolKind,
    BytesKind,
    EnumKind,
    FloatKind,
    IntKind,
    ListKind,
    Number,
    StringKind,
    TimeKind,
)


@dataclass(frozen=True, slots=True)
class Parameter:
    """`accepts` are the kinds that may be passed, `wanted` how a finding calls them."""

    name: str
    accepts: tuple[type, ...]
    wanted: str


@dataclass(frozen=True, slots=True)
class Function:
    """One function. `result` tells the kind of a call from the kinds of its arguments, see `function_kinds`.

    The last parameter may be repeated when `variadic`; `optional` of the last ones may be left out.
    A function with optional bounds takes them from the integer field that it fills (see expressions).
    """

    name: str
    parameters: tuple[Parameter, ...]
    result: Rule
    implementation: Callable[..., object]
    summary: str
    examples: tuple[tuple[str, object], ...]
    variadic: bool = False
    optional: int = 0

    @property
    def signature(self) -> str:
        names = [parameter.name for parameter in self.parameters]
        required = len(names) - self.optional
        shown = names[:required] + [f"{name}=..." for name in names[required:]] + ["..."] * self.variadic
        return f"{self.name}({', '.join(shown)})"


def _number(name: str = "x") -> Parameter:
    return Parameter(name, Number, "a number")


def _whole(name: str = "x") -> Parameter:
    return Parameter(name, (IntKind, EnumKind), "an integer")


def _math(name: str, summary: str, *examples: tuple[str, object], parameters: tuple[str, ...] = ("x",)) -> Function:
    return Function(name, tuple(map(_number, parameters)), result.double, getattr(math, name), summary, examples)


_SIZED = (StringKind, BytesKind, ListKind)
_DECLARED = (
    Function("abs", (_number(),), result.absolute, abs, "The magnitude of a number.", (("abs(-3)", 3),)),
    Function("min", (_number("a"), _number("b")), result.extreme(min), min, "The smallest argument.",
             (("min(2, 1.5)", 1.5),), variadic=True),
    Function("max", (_number("a"), _number("b")), result.extreme(max), max, "The largest argument.",
             (("max(2, 3, 1)", 3),), variadic=True),
    Function("round", (_number(),), result.integer, round_half_even,
             "The nearest integer, the even one of two. NaN and infinities drop the target.",
             (("round(2.6)", 3), ("round(2.5)", 2), ("round(-0.5)", 0))),
    Function("trunc", (_number(),), result.integer, truncate, "The integer towards zero.", (("trunc(-2.7)", -2),)),
    Function("floor", (_number(),), result.integer, floor, "The integer at or below.", (("floor(-2.5)", -3),)),
    Function("ceil", (_number(),), result.integer, ceil, "The integer at or above.", (("ceil(2.1)", 3),)),
    Function("clamp", (_number(), _number("low"), _number("high")), result.clamped, clamp,
             "The number, held between two bounds; without bounds, those of the integer field that it fills.",
             (("clamp(300, 0, 255)", 255), ("clamp(-1.5, -1.0, 1.0)", -1.0)), optional=2),
    Function("wrap", (_whole(), _whole("low"), _whole("high")), result.wrapped, wrap,
             "The integer, counted on from the low bound when it passes the high one; without bounds, those of "
             "the integer field that it fills.",
             (("wrap(256, 0, 255)", 0), ("wrap(-1, 0, 255)", 255), ("wrap(190, -180, 179)", -170)), optional=2),
    _math("radians", "Degrees to radians.", ("radians(180)", math.pi)),
    _math("degrees", "Radians to degrees.", ("degrees(0.0)", 0.0)),
    _math("sqrt", "The square root; of a negative number there is none, and the target is dropped.",
          ("sqrt(9)", 3.0)),
    _math("sin", "The sine of an angle in radians.", ("sin(0)", 0.0)),
    _math("cos", "The cosine of an angle in radians.", ("cos(0)", 1.0)),
    _math("tan", "The tangent of an angle in radians.", ("tan(0)", 0.0)),
    _math("atan2", "The angle of the point (x, y) in radians, -pi to pi.", ("atan2(0, 1)", 0.0),
          parameters=("y", "x")),
    _math("hypot", "The length of the vector (x, y).", ("hypot(3, 4)", 5.0), parameters=("x", "y")),
    Function("float32", (_number(),), result.constant(FloatKind(32)), to_float32,
             "Says that a double, or a large integer, may lose digits in a float32.", (("float32(0.5)", 0.5),)),
    Function("float64", (_number(),), result.constant(FloatKind(64)), float,
             "Says that a large integer may lose digits in a double.", (("float64(3)", 3.0),)),
    Function("int", (Parameter("x", (BoolKind, IntKind, EnumKind), "a bool, an integer or an enum"),),
             result.integer_or_bool, int, "A bool as 0 or 1, an enum as its number.", (("int(True)", 1),)),
    Function("str", (Parameter("x", (BoolKind, IntKind, FloatKind, EnumKind, StringKind), "a scalar"),),
             result.constant(StringKind()), str, "A scalar as text.", (("'wheel_' + str(3)", "wheel_3"),)),
    Function("len", (Parameter("x", _SIZED, "a list, a string or bytes"),), result.constant(IntKind(0, (1 << 32) - 1)),
             len, "How many elements a list has, or characters a string.", (("len([1, 2])", 2),)),
    Function("seconds", (Parameter("time", (TimeKind,), "a time"),), result.constant(FloatKind(64)), seconds,
             "A time as seconds since 1970.", (("seconds(time_from_seconds(1.5))", 1.5),)),
    Function("time_from_seconds", (_number(),), result.constant(TimeKind()), time_from_seconds,
             "Seconds since 1970 as a time.", (("time_from_seconds(2)", 2_000_000_000),)),
    Function("time_from_milliseconds", (_number(),), result.constant(TimeKind()), time_from_milliseconds,
             "Milliseconds since 1970 as a time.", (("time_from_milliseconds(1500)", 1_500_000_000),)),
)  # fmt: skip

FUNCTIONS: Mapping[str, Function] = {function.name: function for function in _DECLARED}
"""By name, without `has`."""

NOT_FINITE: Mapping[str, float] = {"nan": math.nan, "inf": math.inf}
"""What no literal gives, by the name that it has in expressions; a field of that name wins."""

HAS = "has"
"""`has(field)` looks at a field rather than at its value, and so is part of the syntax."""

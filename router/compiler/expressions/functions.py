"""The functions of the expression language: each declared once, with documentation and examples.

The examples are tests (tests/compiler/test_expressions.py), and the reference page is generated from them. Each
function has a rule that returns the kind of a call from its arguments, once their number and kinds are checked; it
raises ValueError with a message if such a call can never succeed. `lowering/functions.py` has their operations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from router.compiler.expressions.kinds import (
    INT64,
    UINT32,
    UINT64,
    BoolKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    Number,
    StringKind,
    TimeKind,
    as_int,
    element_of,
    float_bits,
    length_of,
    within_64_bits,
)
from router.compiler.expressions.tree import Node, constant_of

NS_PER_SECOND = 1_000_000_000
NS_PER_MILLISECOND = 1_000_000
FLOAT32_END = 3.4028235677973366e38
"""The smallest magnitude that does not round to a finite float32."""

MOST_DIGITS = 17
"""Maximum decimals of text(): more do not distinguish doubles."""

# kinds of results

Rule = Callable[[Sequence[Node]], Kind]
"""Returns the kind of a call with these arguments. Raises ValueError if the call can never succeed."""


def _always(kind: Kind) -> Rule:
    return lambda _: kind


def _integers(nodes: Sequence[Node]) -> list[IntKind] | None:
    """Return the arguments as integers; None if one is a float."""
    integers = [kind for node in nodes if (kind := as_int(node.kind))]
    return integers if len(integers) == len(nodes) else None


def _double(nodes: Sequence[Node]) -> FloatKind:
    return FloatKind(max(float_bits(node.kind) for node in nodes))


def _rounded(compute: Callable[[float], int]) -> Rule:
    """Return the rule of a rounding function, which `compute` implements.

    An integer stays as it is. A float becomes a 64-bit integer within the range that clamp() has set.
    """

    def result(nodes: Sequence[Node]) -> Kind:
        kind = nodes[0].kind
        if not isinstance(kind, FloatKind):
            return _integer(nodes)
        if not all(map(math.isfinite, kind.limits)):
            return replace(INT64, is_rounded=True)
        low, high = map(compute, kind.limits)
        if low > INT64.high or high < INT64.low:
            raise ValueError(f"no 64-bit integer is between {kind.low} and {kind.high}")
        return IntKind(max(low, INT64.low), min(high, INT64.high), is_rounded=True)

    return result


def _integer(nodes: Sequence[Node]) -> Kind:
    kind = as_int(nodes[0].kind)
    assert kind is not None  # noqa: S101 - checked before
    return kind


def _integer_or_bool(nodes: Sequence[Node]) -> Kind:
    return IntKind(0, 1) if isinstance(nodes[0].kind, BoolKind) else _integer(nodes)


def _absolute(nodes: Sequence[Node]) -> Kind:
    integers = _integers(nodes)
    if integers is None:
        return _double(nodes)
    (kind,) = integers
    magnitudes = (abs(kind.low), abs(kind.high))
    return IntKind(0 if kind.low <= 0 <= kind.high else min(magnitudes), max(magnitudes), kind.is_rounded)


def _extreme(pick: Callable[[list[int]], int]) -> Rule:
    """Return the rule of min() or max(): the range from the picked low bound to the picked high bound."""

    def result(nodes: Sequence[Node]) -> Kind:
        integers = _integers(nodes)
        if integers is None:
            return _double(nodes)
        low, high = pick([kind.low for kind in integers]), pick([kind.high for kind in integers])
        return IntKind(low, high, any(kind.is_rounded for kind in integers))

    return result


def _extreme_of_list(kind: Kind) -> Kind | None:
    element = element_of(kind)
    return FloatKind(element.bits) if isinstance(element, FloatKind) else as_int(element) if element else None


def _sum_of_list(kind: Kind) -> Kind | None:
    element, length = element_of(kind), length_of(kind)
    if isinstance(element, FloatKind):
        return FloatKind(element.bits)
    integer = as_int(element) if element else None
    if integer is None:
        return None
    if length is not None:
        return within_64_bits((length * integer.low, length * integer.high), integer.is_rounded)[0]
    return replace(INT64 if integer.low < 0 else UINT64, is_rounded=integer.is_rounded)


def _clamped(nodes: Sequence[Node]) -> Kind:
    integers, (_, low, high) = _integers(nodes), nodes
    if integers is not None:
        _require_ordered(integers[1], integers[2])
        return _between(integers[1:])
    ends = [constant_of(low), constant_of(high)]
    if not all(isinstance(end, (int, float)) and math.isfinite(end) for end in ends):
        return _double(nodes)
    first, last = (float(end) for end in ends if end is not None)
    if first > last:
        raise ValueError(f"the low bound {ends[0]} is above the high bound {ends[1]}")
    return replace(_double(nodes), low=first, high=last)


def _wrapped(nodes: Sequence[Node]) -> Kind:
    integers = _integers(nodes)
    assert integers is not None  # noqa: S101 - checked before
    _, low, high = integers
    _require_ordered(low, high)
    return _between([IntKind(low.low, low.low), IntKind(high.high, high.high)])


def _between(bounds: Sequence[IntKind]) -> IntKind:
    """Return the range from the lowest to the highest of these bounds."""
    low, high = min(bound.low for bound in bounds), max(bound.high for bound in bounds)
    if low < 0 and high > INT64.high:
        raise ValueError(f"the bounds {low} to {high} do not fit 64 bits")
    return IntKind(low, high)


def _require_ordered(low: IntKind, high: IntKind) -> None:
    if low.low > high.high:
        raise ValueError(f"the low bound {low.low} is above the high bound {high.high}")


def _written(nodes: Sequence[Node]) -> Kind:
    digits = constant_of(nodes[1])
    if not isinstance(digits, int) or isinstance(digits, bool) or not 0 <= digits <= MOST_DIGITS:
        raise ValueError(f"the number of decimals must be a literal from 0 to {MOST_DIGITS}")
    return StringKind()


# declarations


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: `accepts` are the kinds that may be passed, and `wanted` describes them in findings.

    An integer is converted if the parameter `becomes` a float.
    """

    name: str
    accepts: tuple[type, ...]
    wanted: str
    becomes: FloatKind | None = None


@dataclass(frozen=True, slots=True)
class Function:
    """A function of scalars. `result` returns the kind of a call with these arguments.

    If `variadic`, the last parameter may be repeated; the last `optional` ones may be omitted. A function with optional
    bounds takes them from the integer field that it fills. If its result is one of the arguments (`gives_an_argument`)
    and one of these is a float, all are converted to floats. `of_list` returns the kind of a call with one whole list,
    or None for a list that the function does not take.
    """

    name: str
    parameters: tuple[Parameter, ...]
    result: Rule
    summary: str
    examples: tuple[tuple[str, object], ...]
    variadic: bool = False
    optional: int = 0
    gives_an_argument: bool = False
    of_list: Callable[[Kind], Kind | None] | None = None

    @property
    def signature(self) -> str:
        """A call with all parameters: `clamp(x, low, high)`."""
        names = [parameter.name for parameter in self.parameters] + ["..."] * self.variadic
        return f"{self.name}({', '.join(names)})"


def _number(name: str = "x") -> Parameter:
    return Parameter(name, Number, "a number")


def _whole(name: str = "x") -> Parameter:
    return Parameter(name, (IntKind, EnumKind), "an integer")


def _real(name: str, summary: str, *examples: tuple[str, object], names: tuple[str, ...] = ("x",)) -> Function:
    return Function(name, tuple(map(_number, names)), _double, summary, examples)


_DECLARED = (
    Function("abs", (_number(),), _absolute, "The magnitude of a number.", (("abs(-3)", 3),)),
    Function("min", (_number("a"), _number("b")), _extreme(min),
             "The smallest argument, or the smallest element of a list. An empty list has none: the message is "
             "dropped.",
             (("min(2, 1.5)", 1.5), ("min([3, 1, 2])", 1)), variadic=True, gives_an_argument=True,
             of_list=_extreme_of_list),
    Function("max", (_number("a"), _number("b")), _extreme(max),
             "The largest argument, or the largest element of a list; an empty list drops the message.",
             (("max(2, 3, 1)", 3), ("max([0.5, 2])", 2.0)), variadic=True, gives_an_argument=True,
             of_list=_extreme_of_list),
    Function("sum", (Parameter("x", (), "a list of numbers"),), _double,
             "The sum of a list, added in order; 0 for an empty list.", (("sum([1, 2, 3])", 6), ("sum([1, 0.5])", 1.5)),
             of_list=_sum_of_list),
    Function("round", (_number(),), _rounded(round),
             "The nearest integer; halves round to even. NaN, infinities and results beyond 64 bits drop the message.",
             (("round(2.6)", 3), ("round(2.5)", 2), ("round(-0.5)", 0))),
    Function("trunc", (_number(),), _rounded(math.trunc), "The integer part: rounds towards zero.",
             (("trunc(-2.7)", -2),)),
    Function("floor", (_number(),), _rounded(math.floor), "The largest integer <= x.", (("floor(-2.5)", -3),)),
    Function("ceil", (_number(),), _rounded(math.ceil), "The smallest integer >= x.", (("ceil(2.1)", 3),)),
    Function("clamp", (_number(), _number("low"), _number("high")), _clamped,
             "The number limited to two bounds, by default those of the integer field that it fills.",
             (("clamp(300, 0, 255)", 255), ("clamp(-1.5, -1.0, 1.0)", -1.0)), optional=2, gives_an_argument=True),
    Function("wrap", (_whole(), _whole("low"), _whole("high")), _wrapped,
             "The integer wrapped around between two bounds, by default those of the integer field that it fills.",
             (("wrap(256, 0, 255)", 0), ("wrap(-1, 0, 255)", 255), ("wrap(190, -180, 179)", -170)), optional=2),
    _real("radians", "Degrees to radians.", ("radians(180)", math.pi)),
    _real("degrees", "Radians to degrees.", ("degrees(0.0)", 0.0)),
    _real("sqrt", "The square root. A negative number has none: the message is dropped.",
          ("sqrt(9)", 3.0)),
    _real("sin", "The sine of an angle in radians.", ("sin(0)", 0.0)),
    _real("cos", "The cosine of an angle in radians.", ("cos(0)", 1.0)),
    _real("tan", "The tangent of an angle in radians.", ("tan(0)", 0.0)),
    _real("atan2", "The angle of the point (x, y) in radians, -pi to pi.", ("atan2(0, 1)", 0.0),
          names=("y", "x")),
    _real("hypot", "The length of the vector (x, y).", ("hypot(3, 4)", 5.0), names=("x", "y")),
    Function("float32", (_number(),), _always(FloatKind(32)),
             "The number as a float32; digits of a double or a large integer may be lost.", (("float32(0.5)", 0.5),)),
    Function("float64", (_number(),), _always(FloatKind(64)),
             "The number as a double; digits of a large integer may be lost.", (("float64(3)", 3.0),)),
    Function("int", (Parameter("x", (BoolKind, IntKind, EnumKind), "a bool, an integer or an enum"),),
             _integer_or_bool, "A bool as 0 or 1, an enum as its number.", (("int(True)", 1),)),
    Function("str", (Parameter("x", (BoolKind, IntKind, EnumKind, StringKind), "an integer, an enum, a bool or text"),),
             _always(StringKind()), "An integer, the number of an enum, or a bool (True, False) as text.",
             (("'wheel_' + str(3)", "wheel_3"),)),
    Function("text", (Parameter("x", Number, "a number", becomes=FloatKind(64)), _whole("digits")), _written,
             "A number as text with `digits` decimals, a literal from 0 to 17.",
             (("text(2.675, 1)", "2.7"), ("text(3, 2)", "3.00"))),
    Function("strip", (Parameter("x", (StringKind,), "a string"),), _always(StringKind()),
             "Text without NULs, spaces, tabs and line ends at its start and end. Firmware pads text of fixed "
             "length with NULs, which a ROS string cannot contain.",
             (("strip('  left ')", "left"), ("strip('a b')", "a b"))),
    Function("len", (Parameter("x", (StringKind,), "a list, a string or bytes"),), _always(UINT32),
             "The number of elements of a list or bytes, or of characters of a string.", (("len([1, 2])", 2),),
             of_list=lambda _: UINT32),
    Function("seconds", (Parameter("time", (TimeKind,), "a time"),), _always(FloatKind(64)),
             "A time as seconds since 1970.", (("seconds(time_from_seconds(1.5))", 1.5),)),
    Function("time_from_seconds", (_number(),), _always(TimeKind()),
             "Seconds since 1970 as a time, in 64-bit nanoseconds.",
             (("time_from_seconds(2)", 2_000_000_000),)),
    Function("time_from_milliseconds", (_number(),), _always(TimeKind()),
             "Milliseconds since 1970 as a time, in 64-bit nanoseconds.",
             (("time_from_milliseconds(1500)", 1_500_000_000),)),
)  # fmt: skip

FUNCTIONS: Mapping[str, Function] = {function.name: function for function in _DECLARED}
"""All functions by name, except `has`."""

NOT_FINITE: Mapping[str, float] = {"nan": math.nan, "inf": math.inf}
"""Values that are not literals, by name; a field of that name takes precedence."""

HAS = "has"
"""`has(field)` takes a field instead of its value, so it is part of the syntax."""

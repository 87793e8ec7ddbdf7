"""Whether one scalar value fits the field that it fills, and the syntax that converts it.

The rules: nothing is lost without being asked for. Ranges that are known now are checked now; a range
that only the value tells (a rounded float) is checked at run time and drops the target. An enum
saturates into a narrower integer, as the boards' firmware does.
"""

from __future__ import annotations

import ast
import math

from router.compiler.expressions import Finding, Typed
from router.compiler.implementations import FLOAT32_END, clamp
from router.compiler.kinds import (
    INT32,
    OCTET,
    BoolKind,
    BytesKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    StringKind,
    TimeKind,
)
from router.compiler.syntax import call, load, placed
from router.errors import Code, did_you_mean
from router.types.model import Bool, Bytes, Enum, Float, Int, List, MessageType, String, Type

EXACT_INTEGER_BITS = {32: 24, 64: 53}
"""Up to this many bits every integer is exactly a float of that width."""


def converted(value: Typed, target: Type) -> ast.expr:
    """The expression that fills a scalar field. Raises Finding when it does not fit."""
    _want_finite(value, target)
    match target:
        case Bool():
            return _to_bool(value, target)
        case Int():
            return _to_int(value, target)
        case Float():
            return _to_float(value, target)
        case String():
            return _to_string(value, target)
        case Enum():
            return _to_enum(value, target)
        case Bytes():
            return _to_bytes(value, target)
        case List() | MessageType():
            raise AssertionError(f"{target} is no scalar")


def _want_finite(value: Typed, target: Type) -> None:
    """Raises Finding when `nan` or `inf` would fill what is no float."""
    if isinstance(value.constant, float) and not isinstance(target, Float) and not math.isfinite(value.constant):
        hint = f"text has quotes of its own: \"'{value.constant}'\"" if isinstance(target, String) else ""
        message = f"{value.constant} does not fill {target}"
        raise Finding(value.span, Code.TYPE_MISMATCH, message, hint or "only a float field holds it: write a value")


def mismatch(value: Typed, target: Type, hint: str = "") -> Finding:
    return Finding(value.span, Code.TYPE_MISMATCH, f"{value.kind} does not fill {target}", hint)


def _to_bool(value: Typed, target: Bool) -> ast.expr:
    if isinstance(value.kind, BoolKind):
        return value.node
    raise mismatch(value, target, "compare it, as in x != 0" if isinstance(value.kind, (IntKind, FloatKind)) else "")


def _to_int(value: Typed, target: Int) -> ast.expr:
    match value.kind:
        case EnumKind():
            return _saturate(value, target)
        case IntKind(bounds=bounds):
            return _fit(value, target, bounds)
        case FloatKind():
            hint = "say how: round() or trunc()"
            raise Finding(value.span, Code.LOSSY_CONVERSION, f"a float does not fit {target}", hint)
        case BoolKind():
            raise mismatch(value, target, "int() makes a number of a bool")
        case TimeKind():
            raise mismatch(value, target, "round(seconds(...)) makes a number of a time")
        case _:
            raise mismatch(value, target)


def _saturate(value: Typed, target: Int) -> ast.expr:
    """The usual value passes with one comparison; only one that does not fit costs a call."""
    if target.low <= INT32.low and INT32.high <= target.high:
        return value.node
    if isinstance(value.constant, int):
        return placed(ast.Constant(clamp(value.constant, target.low, target.high)), value.span)
    bind = ast.NamedExpr(ast.Name("v", ast.Store()), value.node)
    inside = ast.Compare(ast.Constant(target.low), [ast.LtE(), ast.LtE()], [bind, ast.Constant(target.high)])
    clamped = call("clamp", load("v"), ast.Constant(target.low), ast.Constant(target.high))
    return placed(ast.IfExp(inside, load("v"), clamped), value.span)


def _fit(value: Typed, target: Int, bounds: tuple[int, int] | None) -> ast.expr:
    if bounds is None:
        return _limited("fit", value, target.low, target.high)
    low, high = bounds
    if target.low <= low and high <= target.high:
        return value.node
    if high < target.low or low > target.high:
        limits = f"{target.low}..{target.high}"
        raise Finding(value.span, Code.OUT_OF_RANGE, f"{value.kind} does not fit {target}", f"it holds {limits}")
    hint = "say how: clamp() or wrap()"
    raise Finding(value.span, Code.LOSSY_CONVERSION, f"{value.kind} does not fit {target}", hint)


def _to_float(value: Typed, target: Float) -> ast.expr:
    limit = 1 << EXACT_INTEGER_BITS[target.bits]
    match value.kind:
        case FloatKind(bits):
            literal = value.constant if isinstance(value.constant, float) else 0.0
            if target.bits == 32 and FLOAT32_END <= abs(literal) < math.inf:
                raise Finding(value.span, Code.OUT_OF_RANGE, f"{literal!r} does not fit float32")
            if bits > target.bits:
                hint = "float32() says that losing digits is meant"
                raise Finding(value.span, Code.LOSSY_CONVERSION, f"a double does not fit {target}", hint)
            return value.node
        case IntKind(bounds=bounds):
            if bounds is None or (-limit <= bounds[0] and bounds[1] <= limit):
                return value.node
            hint = f"float{target.bits}() says that losing digits is meant"
            raise Finding(value.span, Code.LOSSY_CONVERSION, f"{value.kind} does not fit {target}", hint)
        case EnumKind() | BoolKind():
            raise mismatch(value, target, "int() makes a number of it")
        case TimeKind():
            raise mismatch(value, target, "seconds() makes a number of a time")
        case _:
            raise mismatch(value, target)


def _to_string(value: Typed, target: String) -> ast.expr:
    if not isinstance(value.kind, StringKind):
        numeric = isinstance(value.kind, (IntKind, FloatKind, EnumKind, BoolKind))
        raise mismatch(value, target, "str() makes text of it" if numeric else "")
    if isinstance(value.constant, str):
        _want_text(value, value.constant, target)
        return value.node
    if target.bound is None:
        return value.node
    return _limited("fit_wide_text" if target.wide else "fit_text", value, target.bound)


def _want_text(value: Typed, text: str, target: String) -> None:
    """Raises Finding when a literal cannot stand in the field."""
    try:
        length = len(text.encode("utf-16-le")) // 2 if target.wide else len(text.encode())
    except UnicodeEncodeError as error:
        raise Finding(value.span, Code.OUT_OF_RANGE, f"{error.object[error.start]!a} is no character") from None
    if not target.wide and "\0" in text:
        raise Finding(value.span, Code.OUT_OF_RANGE, "a string cannot hold a NUL")
    if target.bound is not None and length > target.bound:
        unit = "characters" if target.wide else "bytes"
        raise Finding(value.span, Code.OUT_OF_RANGE, f"{length} {unit} do not fit {target}")


def _to_enum(value: Typed, target: Enum) -> ast.expr:
    match value.kind:
        case EnumKind(enum) if enum == target:
            return value.node
        case IntKind(bounds=bounds):
            return _fit(value, INT32, bounds)
        case StringKind() if isinstance(value.constant, str):
            return placed(ast.Constant(_number_of(value, value.constant, target)), value.span)
        case StringKind():
            return value.node  # protobuf takes names for numbers, and refuses those that it does not know
        case _:
            raise mismatch(value, target, f"name one of its values: {target.name}.{target.values[0][0]}")


def _number_of(value: Typed, name: str, target: Enum) -> int:
    numbers = dict(target.values)
    if name not in numbers:
        hint = did_you_mean(name, numbers)
        raise Finding(value.span, Code.UNKNOWN_ENUM_VALUE, f"'{target}' has no value '{name}'", hint)
    return numbers[name]


def _to_bytes(value: Typed, target: Bytes) -> ast.expr:
    match value.kind:
        case BytesKind():
            made = value
        case ListKind(element, length) if element is None or _is_octet(element):
            if target.bound is not None and length is not None and length > target.bound:
                raise Finding(value.span, Code.OUT_OF_RANGE, f"{length} bytes do not fit {target}")
            made = Typed.at(value.span, BytesKind(), call("bytes", value.node))
        case ListKind():
            raise mismatch(value, target, f"bytes are integers {OCTET.low}..{OCTET.high}")
        case _:
            raise mismatch(value, target)
    return made.node if target.bound is None else _limited("fit_text", made, target.bound)


def _is_octet(kind: Kind) -> bool:
    """Whether an element of this kind can be a byte; one of which only the value tells is checked at run time."""
    if not isinstance(kind, IntKind):
        return False
    return kind.bounds is None or OCTET.low <= kind.bounds[0] <= kind.bounds[1] <= OCTET.high


def _limited(function: str, value: Typed, *limits: int) -> ast.expr:
    """The value, passed at run time by one of the checks of `implementations`."""
    return placed(call(function, value.node, *map(ast.Constant, limits)), value.span)

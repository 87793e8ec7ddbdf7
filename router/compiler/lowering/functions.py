"""Lowers the language's functions, and the checks of `conversion`."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from router.compiler.expressions import tree
from router.compiler.expressions.functions import NS_PER_MILLISECOND, NS_PER_SECOND
from router.compiler.expressions.kinds import (
    BoolKind,
    EnumKind,
    FloatKind,
    IntKind,
    StringKind,
    TimeKind,
)
from router.compiler.lowering import lists
from router.compiler.lowering.numbers import bounds, fitted, is_unsigned, signs, to_real
from router.compiler.lowering.operations import DROP, Operation, Routine, integer, load, real, routine, store, text
from router.declared import MAX_DATAGRAM, Compared, Op, Relation

if TYPE_CHECKING:
    from router.compiler.lowering.expressions import Lowering

_OF_REALS = {
    "sqrt": Op.SQRT, "sin": Op.SIN, "cos": Op.COS, "tan": Op.TAN, "atan2": Op.ATAN2, "hypot": Op.HYPOT,
    "float32": Op.FLOAT32,
}  # fmt: skip
_ROUNDINGS = {"round": Op.ROUND, "trunc": Op.TRUNCATE, "floor": Op.FLOOR, "ceil": Op.CEIL}
_FACTORS = {"radians": math.pi / 180, "degrees": 180 / math.pi}
_TIMES = {"time_from_seconds": NS_PER_SECOND, "time_from_milliseconds": NS_PER_MILLISECOND}
_OF_THREE = {"clamp": (Op.CLAMP, Op.REAL_CLAMP), "wrap": (Op.WRAP, None)}
EXTREMES = {"min": (Op.LEAST, Op.REAL_LEAST), "max": (Op.GREATEST, Op.REAL_GREATEST)}
"""Operations on integers and on real numbers."""

_LONGEST_DECIMAL, _LONGEST_DIGITS = 20, 1 + 309 + 1 + 17
"""Maximum characters of an integer, and of a double with 17 decimals."""


def called(lowering: Lowering, node: tree.Call) -> Routine:
    """Return the operations that push the result of a call."""
    name, first = node.function, node.arguments[0]
    if name in EXTREMES:
        return _extreme(lowering, node)
    if name in _OF_REALS:
        return routine(*map(lowering.real, node.arguments), Operation(_OF_REALS[name]))
    if name in _ROUNDINGS:
        value = lowering.value(first)
        return routine(value, Operation(_ROUNDINGS[name])) if isinstance(first.kind, FloatKind) else value
    if name in _FACTORS:
        return routine(lowering.real(first), real(_FACTORS[name]), Operation(Op.REAL_MULTIPLY))
    if name in _TIMES:
        return _time(lowering, first, _TIMES[name])
    if name in _OF_THREE:
        return _between(lowering, node)
    return _OTHERS[name](lowering, node)


# ---- numbers


def _extreme(lowering: Lowering, node: tree.Call) -> Routine:
    of_integers, of_reals = EXTREMES[node.function]
    if len(node.arguments) == 1:
        return lists.extreme(lowering, node, of_integers, of_reals)
    first, *others = node.arguments
    if isinstance(node.kind, FloatKind):
        return routine(lowering.real(first), *(routine(lowering.real(other), Operation(of_reals)) for other in others))
    value, kind = lowering.value(first), first.kind
    pick = min if of_integers is Op.LEAST else max
    for other in others:
        (low, high), (low_too, high_too) = bounds(kind), bounds(other.kind)
        result = IntKind(pick(low, low_too), pick(high, high_too))
        value = routine(value, lowering.value(other), Operation(of_integers, flag=signs(result, kind, other.kind)))
        kind = result
    return value


def _between(lowering: Lowering, node: tree.Call) -> Routine:
    """Lower clamp() and wrap()."""
    of_integers, of_reals = _OF_THREE[node.function]
    if isinstance(node.kind, FloatKind):
        assert of_reals is not None  # noqa: S101 - wrap() takes integers
        return routine(*map(lowering.real, node.arguments), Operation(of_reals))
    flag = signs(node.kind, *(argument.kind for argument in node.arguments))
    return routine(*map(lowering.value, node.arguments), Operation(of_integers, flag=flag))


def _fit(lowering: Lowering, node: tree.Call) -> Routine:
    first, low, high = node.arguments
    assert isinstance(low, tree.Constant)  # noqa: S101 - as `tree.CHECKS` says
    assert isinstance(high, tree.Constant)  # noqa: S101
    return fitted(lowering.value(first), first.kind, IntKind(int(low.value), int(high.value)))


def _time(lowering: Lowering, node: tree.Node, factor: int) -> Routine:
    """Lower a number times `factor` as a time in ns. A time that does not fit 64 bits is rejected."""
    if isinstance(node.kind, FloatKind):
        return routine(lowering.value(node), real(factor), Operation(Op.REAL_MULTIPLY), Operation(Op.ROUND))
    flag = signs(TimeKind(), node.kind)
    return routine(lowering.value(node), integer(factor), Operation(Op.CHECKED_MULTIPLY, flag=flag))


def _absolute(lowering: Lowering, node: tree.Call) -> Routine:
    (first,) = node.arguments
    value = lowering.value(first)
    if isinstance(node.kind, FloatKind):
        return routine(to_real(value, first.kind), Operation(Op.REAL_ABSOLUTE))
    return routine(value, Operation(Op.ABSOLUTE)) if bounds(first.kind)[0] < 0 else value


def _seconds(lowering: Lowering, node: tree.Call) -> Routine:
    return routine(lowering.real(node.arguments[0]), real(NS_PER_SECOND), Operation(Op.REAL_DIVIDE))


# ---- enums


def _named(lowering: Lowering, node: tree.Call) -> Routine:
    """Lower the conversion of an enum's name to its number. Other text is rejected."""
    assert isinstance(node.kind, EnumKind)  # noqa: S101 - as `tree.CHECKS` says
    slot = lowering.names.temporary()
    numbers: Routine = (load(slot), Operation(Op.NAMELESS))
    for name, number in reversed(node.kind.enum.values):
        is_it = load(slot), text(name.encode()), Operation(Op.COMPARE, int(Compared.TEXTS), flag=Relation.EQUAL)
        numbers = routine(
            is_it, Operation(Op.UNLESS, size=2), integer(number), Operation(Op.JUMP, size=len(numbers)), numbers
        )
    return routine(lowering.value(node.arguments[0]), store(slot), DROP, numbers)


def _member(lowering: Lowering, node: tree.Call) -> Routine:
    """Lower the check that a number is a value of a closed enum. Other numbers are rejected."""
    assert isinstance(node.kind, EnumKind)  # noqa: S101 - as `tree.CHECKS` says
    numbers = sorted({number for _, number in node.kind.enum.values})
    data = struct.pack(f"<{len(numbers)}i", *numbers)
    return routine(lowering.value(node.arguments[0]), Operation(Op.MEMBER, size=len(numbers), data=data))


# ---- text and bytes


def longest(node: tree.Node) -> int:
    """Return the maximum bytes of a text. Text of a ROS message can be longer: the machine then rejects it."""
    match node:
        case tree.Constant(value=str(value)):
            return len(value.encode())
        case tree.Binary():
            return longest(node.left) + longest(node.right)
        case tree.Choice():
            return max(longest(node.body), longest(node.orelse))
        case tree.Call(function="str"):
            is_text = isinstance(node.arguments[0].kind, StringKind)
            return longest(node.arguments[0]) if is_text else _LONGEST_DECIMAL
        case tree.Call(function="strip"):
            return longest(node.arguments[0])
        case tree.Call(function="text"):
            return _LONGEST_DIGITS
        case _:
            return MAX_DATAGRAM


def _str(lowering: Lowering, node: tree.Call) -> Routine:
    (first,) = node.arguments
    value = lowering.value(first)
    if isinstance(first.kind, StringKind):
        return value
    if isinstance(first.kind, BoolKind):
        yes, no = text(b"True"), text(b"False")
        return routine(value, Operation(Op.UNLESS, size=2), yes, Operation(Op.JUMP, size=1), no)
    lowering.names.count_text(_LONGEST_DECIMAL, node.span)
    return routine(value, Operation(Op.DECIMAL, flag=is_unsigned(first.kind)))


def _text(lowering: Lowering, node: tree.Call) -> Routine:
    number, digits = node.arguments
    assert isinstance(digits, tree.Constant)  # noqa: S101 - it is a literal
    lowering.names.count_text(_LONGEST_DIGITS, node.span)
    return routine(lowering.real(number), Operation(Op.DIGITS, int(digits.value)))


def _length(lowering: Lowering, node: tree.Call) -> Routine:
    (first,) = node.arguments
    if isinstance(first.kind, StringKind):
        return routine(lowering.value(first), Operation(Op.CHARACTERS))
    return lists.length(lowering, first)


def _fit_text(lowering: Lowering, node: tree.Call) -> Routine:
    first, most = node.arguments
    assert isinstance(most, tree.Constant)  # noqa: S101 - as `tree.CHECKS` says
    return routine(lowering.value(first), Operation(Op.FIT_SIZE, number=int(most.value)))


def _octets(lowering: Lowering, node: tree.Call) -> Routine:
    (first,) = node.arguments
    if (known := tree.constant_bytes(node)) is not None:
        return (text(known),)
    listed = lists.lower_list(lowering, first)
    return listed.routine if listed.is_octets else routine(listed.routine, Operation(Op.OCTETS, flag=listed.scalar))


def _same(lowering: Lowering, node: tree.Call) -> Routine:
    return lowering.value(node.arguments[0])


_OTHERS: Mapping[str, Callable[[Lowering, tree.Call], Routine]] = {
    "abs": _absolute,
    "fit": _fit,
    "float64": lambda lowering, node: lowering.real(node.arguments[0]),
    "fit_text": _fit_text,
    "int": _same,
    "len": _length,
    "member": _member,
    "named": _named,
    "octets": _octets,
    "seconds": _seconds,
    "strip": lambda lowering, node: routine(lowering.value(node.arguments[0]), Operation(Op.STRIP)),
    "str": _str,
    "sum": lists.total,
    "text": _text,
}

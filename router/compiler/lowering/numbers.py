"""Numbers on the stack: signs, conversions and comparisons, which depend on the ranges of their kinds."""

from __future__ import annotations

from collections.abc import Mapping

from router.compiler.expressions import tree
from router.compiler.expressions.kinds import (
    INT64,
    BoolKind,
    BytesKind,
    FloatKind,
    IntKind,
    Kind,
    StringKind,
    as_int,
)
from router.compiler.lowering.operations import Operation, Routine, integer, routine
from router.declared import Compared, Op, Relation, Sign


def bounds(kind: Kind) -> tuple[int, int]:
    """Return the range of an integer, which may represent a bool, an enum's value or a time."""
    if isinstance(kind, BoolKind):
        return 0, 1
    number = as_int(kind) or INT64
    return number.low, number.high


def is_unsigned(kind: Kind) -> bool:
    """Return whether the 64 bits of an integer are unsigned: its range exceeds int64."""
    return bounds(kind)[1] > INT64.high


def signs(result: Kind, *operands: Kind) -> int:
    """Return the flags that mark unsigned operands, and an unsigned result, of an operation with integers."""
    flags = (Sign.FIRST_UNSIGNED, Sign.SECOND_UNSIGNED, Sign.THIRD_UNSIGNED)
    unsigned = sum(int(flag) for flag, kind in zip(flags, operands, strict=False) if is_unsigned(kind))
    return unsigned + int(Sign.RESULT_UNSIGNED) * is_unsigned(result)


def to_real(value: Routine, kind: Kind) -> Routine:
    """Convert a number to a real number."""
    if isinstance(kind, FloatKind):
        return value
    return routine(value, Operation(Op.INTEGER_TO_REAL, flag=is_unsigned(kind)))


def coerced(value: Routine, kind: Kind, to: Kind) -> Routine:
    """Convert a value of `kind` to the common kind `to`."""
    if isinstance(to, FloatKind):
        return to_real(value, kind)
    if isinstance(to, IntKind) and not isinstance(kind, BoolKind):
        return fitted(value, kind, to) if is_unsigned(kind) and not is_unsigned(to) else value
    return value


def fitted(value: Routine, kind: Kind, to: Kind) -> Routine:
    """Add operations that reject an integer outside the range of the kind `to`."""
    (low, high), (least, most) = bounds(kind), bounds(to)
    if least <= low and high <= most:
        return value
    ends = IntKind(least, least), IntKind(most, most)
    return routine(value, integer(least), integer(most), Operation(Op.FIT, flag=signs(to, kind, *ends)))


_SWAPPED: Mapping[Relation, Relation] = {
    Relation.LESS: Relation.GREATER,
    Relation.LESS_OR_EQUAL: Relation.GREATER_OR_EQUAL,
    Relation.GREATER: Relation.LESS,
    Relation.GREATER_OR_EQUAL: Relation.LESS_OR_EQUAL,
}
"""Relations that change if the two values are swapped, with the swapped relation."""


def compare(relation: tree.Relation, left: Routine, right: Routine, left_kind: Kind, right_kind: Kind) -> Routine:
    """Lower an exact comparison. The right operand may be evaluated first: the operation requires an integer before a
    real number, and a signed integer before an unsigned one.
    """
    straight = Relation[relation.name]
    how = _compared(left_kind, right_kind)
    if how is not None:
        return routine(left, right, Operation(Op.COMPARE, int(how), flag=straight))
    how = _compared(right_kind, left_kind)
    assert how is not None  # noqa: S101 - one of two orders is right
    return routine(right, left, Operation(Op.COMPARE, int(how), flag=_SWAPPED.get(straight, straight)))


def _compared(left: Kind, right: Kind) -> Compared | None:
    """Return how two values are compared in this order; None if they must be swapped."""
    if isinstance(left, (StringKind, BytesKind)):
        return Compared.TEXTS
    if isinstance(left, FloatKind):
        return Compared.REALS if isinstance(right, FloatKind) else None
    if isinstance(right, FloatKind):
        return Compared.UNSIGNED_WITH_REAL if is_unsigned(left) else Compared.SIGNED_WITH_REAL
    if not is_unsigned(left) and not is_unsigned(right):
        return Compared.SIGNED_INTEGERS
    if bounds(left)[0] >= 0 and bounds(right)[0] >= 0:
        return Compared.UNSIGNED_INTEGERS
    return None if is_unsigned(left) else Compared.SIGNED_WITH_UNSIGNED

"""Of which kind a call is, given the kinds of its arguments: integer ranges go through functions where that is known.

Each rule takes the arguments' kinds in order; the check has seen to their number and that each is accepted. It
raises ValueError with a sentence when no call with such arguments works. Knows no syntax and no values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from router.compiler.kinds import ANY_INT, BoolKind, FloatKind, IntKind, Kind, as_int, float_bits, join

Rule = Callable[[Sequence[Kind]], Kind]


def constant(kind: Kind) -> Rule:
    return lambda _: kind


def same(kinds: Sequence[Kind]) -> Kind:
    """The kind that holds all arguments."""
    joined = kinds[0]
    for kind in kinds[1:]:
        joined = join(joined, kind) or joined
    return joined


def double(kinds: Sequence[Kind]) -> Kind:
    return FloatKind(max(map(float_bits, kinds)))


def integer(kinds: Sequence[Kind]) -> Kind:
    """Integers stay what they are; of a float only the value at run time tells."""
    return as_int(kinds[0]) or ANY_INT


def integer_or_bool(kinds: Sequence[Kind]) -> Kind:
    return IntKind(0, 1) if isinstance(kinds[0], BoolKind) else integer(kinds)


def absolute(kinds: Sequence[Kind]) -> Kind:
    bounds = _bounds(kinds[0])
    if bounds is None:
        return kinds[0]
    low, high = bounds
    magnitudes = (abs(low), abs(high))
    return IntKind(0 if low <= 0 <= high else min(magnitudes), max(magnitudes))


def extreme(pick: Callable[[list[int]], int]) -> Rule:
    """For min() and max(): the picked one of the low bounds to the picked one of the high bounds."""

    def result(kinds: Sequence[Kind]) -> Kind:
        known = [bounds for kind in kinds if (bounds := _bounds(kind))]
        if len(known) != len(kinds):
            return same(kinds)
        return IntKind(pick([low for low, _ in known]), pick([high for _, high in known]))

    return result


def clamped(kinds: Sequence[Kind]) -> Kind:
    low, high = _bounds(kinds[1]), _bounds(kinds[2])
    if low and high:
        _want_ordered(low[0], high[1])
    if any(as_int(kind) is None for kind in kinds):
        return same(kinds)
    if low is None or high is None:
        return ANY_INT
    return IntKind(min(low[0], high[0]), max(low[1], high[1]))


def wrapped(kinds: Sequence[Kind]) -> Kind:
    low, high = _bounds(kinds[1]), _bounds(kinds[2])
    if low is None or high is None:
        return ANY_INT
    _want_ordered(low[0], high[1])
    # Only the value tells where the bounds may be the wrong way round.
    return IntKind(low[0], high[1]) if low[1] <= high[0] else ANY_INT


def _bounds(kind: Kind) -> tuple[int, int] | None:
    number = as_int(kind)
    return number.bounds if number else None


def _want_ordered(low: int, high: int) -> None:
    if low > high:
        raise ValueError(f"the low bound {low} is above the high bound {high}")

"""Regular expressions that are done once they have seen each character: all states at once, and never back.

Python's own go back and try again, for minutes with some patterns, and hold the interpreter lock meanwhile. Here its
parser is used, its engine is not. Knows no topic.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

_PARSER: Any = importlib.import_module("re._parser" if sys.version_info >= (3, 11) else "sre_parse")

MOST_STATES = 256
"""As many characters as ROS lets a name have. Each character of a pattern is a state, in a counted repeat several."""
_MOST_KEPT = 1024

_CATEGORIES = {"DIGIT": r"\d", "NOT_DIGIT": r"\D", "SPACE": r"\s", "NOT_SPACE": r"\S", "WORD": r"\w", "NOT_WORD": r"\W"}
_BEGINNINGS = ("AT_BEGINNING", "AT_BEGINNING_STRING")
_ENDS = ("AT_END", "AT_END_STRING")
_REFUSED = {
    "GROUPREF": "a backreference",
    "GROUPREF_EXISTS": "a backreference",
    "ASSERT": "a look ahead or behind",
    "ASSERT_NOT": "a look ahead or behind",
    "ATOMIC_GROUP": "a group that gives nothing back",
    "POSSESSIVE_REPEAT": "a repeat that gives nothing back",
    "AT": "an anchor within",
}
_FLAGS = "flags"

Accepts = Callable[[str], object]
"""Says something true of the characters that lead into a state."""


class UnsupportedError(ValueError):
    """A regular expression of Python's that is none here; the text says what it has."""


class _Fragment(NamedTuple):
    """A part of a pattern: the states that it may begin and end with, as bits, and whether it may be left out."""

    first: int = 0
    last: int = 0
    is_optional: bool = True


_NOTHING = _Fragment()


class Automaton:
    """Matches whole texts. Raises re.error, OverflowError and RecursionError as `re`, and UnsupportedError."""

    def __init__(self, pattern: str) -> None:
        self._accepts: list[Accepts] = []
        self._followers: dict[int, int] = {}
        tree = _PARSER.parse(pattern)
        if tree.state.flags & ~re.UNICODE:
            raise UnsupportedError(_FLAGS)
        self._start, self._ends, self._takes_nothing = self._sequence(_unanchored(tree))
        self._masks: dict[str, int] = {}
        self._reached: dict[int, int] = {}

    def matches(self, text: str) -> bool:
        if not text:
            return self._takes_nothing
        reachable, states = self._start, 0
        for character in text:
            states = reachable & self._mask(character)
            if not states:
                return False
            reachable = self._next(states)
        return bool(states & self._ends)

    def _mask(self, character: str) -> int:
        """The states that a character leads into."""
        mask = self._masks.get(character)
        if mask is None:
            mask = sum(1 << state for state, accepts in enumerate(self._accepts) if accepts(character))
            _keep(self._masks, character, mask)
        return mask

    def _next(self, states: int) -> int:
        """The states that can follow any of these."""
        reached = self._reached.get(states)
        if reached is None:
            reached = 0
            for state in _each(states):
                reached |= self._followers[state]
            _keep(self._reached, states, reached)
        return reached

    def _sequence(self, parts: Iterable[tuple[Any, Any]]) -> _Fragment:
        whole = _NOTHING
        for operator, value in parts:
            whole = self._joined(whole, self._part(operator.name, value))
        return whole

    def _part(self, operator: str, value: Any) -> _Fragment:
        match operator:
            case "SUBPATTERN":
                _, added, removed, parts = value
                if added or removed:
                    raise UnsupportedError(_FLAGS)
                return self._sequence(parts)
            case "BRANCH":
                return _either([self._sequence(parts) for parts in value[1]])
            case "MAX_REPEAT" | "MIN_REPEAT":
                return self._repeated(*value)
        if operator in _REFUSED:
            raise UnsupportedError(_REFUSED[operator])
        return self._state(_accepting(operator, value))

    def _state(self, accepts: Accepts) -> _Fragment:
        if len(self._accepts) == MOST_STATES:
            raise UnsupportedError(f"more than {MOST_STATES} characters, those of counted repeats written out")
        bit = 1 << len(self._accepts)
        self._accepts.append(accepts)
        self._followers[bit] = 0
        return _Fragment(bit, bit, is_optional=False)

    def _repeated(self, low: int, high: int, parts: Sequence[tuple[Any, Any]]) -> _Fragment:
        """Written out: `a{2,}` is `aa+`, `a{1,3}` is `aa?a?`."""
        is_endless = high == _PARSER.MAXREPEAT
        copies = max(low, 1) if is_endless else high
        whole = _NOTHING
        for copy in range(copies):
            states = len(self._accepts)
            one = self._sequence(parts)
            if len(self._accepts) == states:
                return one  # nothing, however often
            if is_endless and copy == copies - 1:
                self._joined(one, one)
            whole = self._joined(whole, one._replace(is_optional=True) if copy >= low else one)
        return whole

    def _joined(self, one: _Fragment, other: _Fragment) -> _Fragment:
        for state in _each(one.last):
            self._followers[state] |= other.first
        return _Fragment(
            first=one.first | other.first if one.is_optional else one.first,
            last=one.last | other.last if other.is_optional else other.last,
            is_optional=one.is_optional and other.is_optional,
        )


def _either(fragments: Iterable[_Fragment]) -> _Fragment:
    first = last = 0
    is_optional = False
    for fragment in fragments:
        first, last, is_optional = first | fragment.first, last | fragment.last, is_optional or fragment.is_optional
    return _Fragment(first, last, is_optional)


def _unanchored(tree: Iterable[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Without what says that the text begins and ends here, which is so anyway."""
    parts = list(tree)
    if parts and parts[0][0].name == "AT" and parts[0][1].name in _BEGINNINGS:
        del parts[0]
    if parts and parts[-1][0].name == "AT" and parts[-1][1].name in _ENDS:
        del parts[-1]
    return parts


def _accepting(operator: str, value: Any) -> Accepts:
    match operator:
        case "LITERAL":
            return chr(value).__eq__
        case "NOT_LITERAL":
            return chr(value).__ne__
        case "ANY":
            return "\n".__ne__
        case "RANGE":
            first, last = map(chr, value)
            return lambda character: first <= character <= last
        case "CATEGORY":
            return re.compile(_CATEGORIES[value.name.removeprefix("CATEGORY_")]).match
        case "IN":
            is_negated = value[0][0].name == "NEGATE"
            members = [_accepting(inner.name, given) for inner, given in value[is_negated:]]
            return lambda character: any(accepts(character) for accepts in members) is not is_negated
    raise AssertionError(f"the parser has no '{operator}'")


def _each(states: int) -> Iterator[int]:
    """The bits one by one, the lowest first."""
    while states:
        lowest = states & -states
        yield lowest
        states ^= lowest


def _keep(kept: dict[Any, int], key: object, value: int) -> None:
    """A text that keeps leading elsewhere must not fill the memory."""
    if len(kept) == _MOST_KEPT:
        kept.clear()
    kept[key] = value

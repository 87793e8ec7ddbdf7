"""Selects the topics that a gateway sends, and their rates, by patterns over absolute topic names.

Only `pattern_problem` accepts invalid patterns.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from functools import lru_cache
from typing import NamedTuple

from router.table.model.gateways import Gateway, TopicPattern, TopicRate

_WILDCARDS = re.compile(r"[*?]")
_PART = re.compile(r"\*\*|(?:[A-Za-z0-9_?]|\*(?!\*))+")
_ANY_PARTS = "**"
_REMEMBERED = 4096
"""Number of topics whose answers are cached, because each discovery needs them."""


class PatternProblem(NamedTuple):
    """Why a pattern is invalid, and the remedy."""

    what: str
    hint: str


def pattern_problem(pattern: TopicPattern) -> PatternProblem | None:
    """Return why the pattern is invalid, or None."""
    if pattern.is_regex:
        try:
            re.compile(pattern.text)
        except (re.error, OverflowError, RecursionError) as error:
            hint = "write a Python regular expression that matches whole names"
            return PatternProblem(f"'{pattern.text}' is not a regular expression: {error}", hint)
        return None
    if not pattern.text.startswith("/"):
        hint = f"patterns match absolute topic names; did you mean '/{pattern.text}' or '/**/{pattern.text}'?"
        return PatternProblem(f"'{pattern.text}' does not begin with '/'", hint)
    if wrong := [part for part in _parts(pattern.text) if not _PART.fullmatch(part)]:
        what = f"'{wrong[0]}' is not a valid part of a topic name" if wrong[0] else "one of its parts is empty"
        hint = "write parts of letters, digits, '_', '*' and '?', or '**' alone; for anything else, use {regex: ...}"
        return PatternProblem(f"'{pattern.text}' matches no topic: {what}", hint)
    return None


class _Answer(NamedTuple):
    """The pattern that includes a topic, and the entry of `rates` that applies to it."""

    chosen: TopicPattern | None
    rate: TopicRate | None


class TopicSelector:
    """Selects topics for one gateway. `inbound` are the absolute names of topics that its clients publish on."""

    def __init__(self, settings: Gateway, inbound: Collection[str]) -> None:
        include = settings.include or (TopicPattern("/**", is_regex=False, span=settings.span),)
        self._include = [(pattern, matcher(pattern)) for pattern in include]
        self._exclude = [matcher(pattern) for pattern in settings.exclude]
        self._rates = [(matcher(rate.pattern), rate) for rate in settings.rates]
        self._named = {pattern.text for pattern in settings.include if is_name(pattern)}
        self._inbound = frozenset(inbound)
        self._publish_period = settings.publish_period
        self._answers = lru_cache(_REMEMBERED)(self._answer)

    def selects(self, topic: str) -> bool:
        return self.chosen_by(topic) is not None

    def names(self, topic: str) -> bool:
        """Return whether `include` has the topic's exact name."""
        return topic in self._named

    def chosen_by(self, topic: str) -> TopicPattern | None:
        """Return the first pattern that includes the topic, or None.

        Hidden topics, and those that clients publish on, are only included by name.
        """
        return self._answers(topic).chosen

    def period(self, topic: str) -> int:
        """Return the period of a topic in ns, or EACH."""
        rate = self._answers(topic).rate
        return rate.period if rate else self._publish_period

    def rated_by(self, topic: str) -> TopicPattern | None:
        """Return the pattern of `rates` that sets the period, or None for `publish_period`."""
        rate = self._answers(topic).rate
        return rate.pattern if rate else None

    def _answer(self, topic: str) -> _Answer:
        rate = next((rate for matches, rate in self._rates if matches(topic)), None)
        return _Answer(self._choice(topic), rate)

    def _choice(self, topic: str) -> TopicPattern | None:
        if any(matches(topic) for matches in self._exclude):
            return None
        if (is_hidden(topic) or topic in self._inbound) and not self.names(topic):
            return None
        return next((pattern for pattern, matches in self._include if matches(topic)), None)


def is_hidden(topic: str) -> bool:
    """Return whether ROS hides the topic: a part of its name begins with `_`, as with the topics of actions."""
    return any(part.startswith("_") for part in _parts(topic))


def is_name(pattern: TopicPattern) -> bool:
    """Return whether the pattern is the name of one topic."""
    return not pattern.is_regex and not _WILDCARDS.search(pattern.text)


def _parts(text: str) -> list[str]:
    return text.split("/")[1:]


def matcher(pattern: TopicPattern) -> Callable[[str], object]:
    """Return a function that is true of the names that a valid pattern matches."""
    if is_name(pattern):
        return pattern.text.__eq__
    return re.compile(pattern.text if pattern.is_regex else _regex(pattern.text)).fullmatch


def _regex(glob: str) -> str:
    """Return the regular expression of a glob. `**` matches any number of parts, at the end at least one."""
    *inner, last = _parts(glob)
    parts = [r"(?:/[^/]+)*" if part == _ANY_PARTS else _part_regex(part) for part in inner]
    return "".join([*parts, r"(?:/[^/]+)+" if last == _ANY_PARTS else _part_regex(last)])


def _part_regex(part: str) -> str:
    if part == "*":
        return "/[^/]+"
    return "/" + part.replace("*", "[^/]*").replace("?", "[^/]")

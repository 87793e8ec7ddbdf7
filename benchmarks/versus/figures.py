"""Medians, ratios and verdicts. Pure arithmetic: knows neither scenarios nor where figures come from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from benchmarks.versus.trial import Metrics

COUNTED = ("lost", "ros_lost", "too_slow", "not_overloaded", "invalid")
"""Where one of these is above 0, what was measured under the same condition does not count."""


class Spread(NamedTuple):
    median: float
    min: float
    max: float


@dataclass(frozen=True)
class Aim:
    """A figure to be shown: a metric of a contender, or its ratio to that of another. It may have a limit."""

    metric: str
    against: str | None = None
    of: str = "router"
    at_most: float | None = None
    at_least: float | None = None

    def text(self) -> str:
        if self.at_most is not None:
            return f"<= {self.at_most:g}"
        return f">= {self.at_least:g}" if self.at_least is not None else ""

    def verdict(self, value: float, counts: bool) -> str:
        """`void`, `met` or `missed`; where there is no limit, `void` or empty."""
        if not counts:
            return "void"
        if not self.text():
            return ""
        high = self.at_most is not None and value > self.at_most
        low = self.at_least is not None and value < self.at_least
        return "missed" if high or low else "met"


def spread(values: Sequence[float]) -> Spread:
    return Spread(*(round(value, 4) for value in (median(values), min(values), max(values))))


def spreads(rounds: Sequence[Metrics]) -> dict[str, Spread]:
    """Of each metric that every round has."""
    shared = [metric for metric in rounds[0] if all(metric in metrics for metrics in rounds)]
    return {metric: spread([metrics[metric] for metrics in rounds]) for metric in shared}


def ratio(metric: str, ours: Sequence[Metrics], theirs: Sequence[Metrics]) -> Spread | None:
    """The ratio of the medians; the range is that of the pairs, each measured in turn. None where one is missing."""
    pairs = [(a[metric], b[metric]) for a, b in zip(ours, theirs, strict=True) if metric in a and b.get(metric)]
    if len(pairs) < len(ours):
        return None
    each = [a / b for a, b in pairs]
    return spread([median(a for a, _ in pairs) / median(b for _, b in pairs)])._replace(
        min=round(min(each), 4), max=round(max(each), 4)
    )


def counts(metric: str, rounds: Iterable[Metrics]) -> bool:
    """Whether all that was sent arrived, and was as much as it should be, where this metric was measured."""
    _, at, condition = metric.partition("@")
    return not any(metrics.get(f"{name}{at}{condition}") for metrics in rounds for name in COUNTED)


class Judged(NamedTuple):
    """An aim, the figure that it is about, and whether that is met."""

    aim: Aim
    value: Spread
    verdict: str


def judge(aims: Iterable[Aim], rounds: Mapping[str, Sequence[Metrics]]) -> list[Judged]:
    """`rounds` are those of each contender. What was not measured is left out."""
    judged = []
    for aim in aims:
        first = rounds.get(aim.of, [])
        other = rounds.get(aim.against, []) if aim.against else []
        if not first or bool(other) != bool(aim.against):
            continue
        value = ratio(aim.metric, first, other) if aim.against else spreads(first).get(aim.metric)
        if value is not None:
            is_sound = counts(aim.metric, [*first, *other])
            judged.append(Judged(aim, value, aim.verdict(value.median, is_sound)))
    return judged

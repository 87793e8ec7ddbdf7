"""Medians, ratios to the router left alone, and verdicts. Pure arithmetic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.versus.figures import Aim, Spread, spread
from benchmarks.versus.trial import Metrics

ALONE = "alone"
MOST_RATIO, MOST_US = 2.0, 2000.0
"""Of the 99th percentile of forwarding under pressure: to that of the router alone, and in itself."""

MOST_BRAKE_MS = {"busy": 50.0}
MOST_BRAKE_MS_ELSE = 10.0
BRAKES = ("brake_udp_max_ms", "brake_ros_max_ms")
P99 = "udp_p99_us"

COLUMNS = {
    "udp_p50_us": "p50 us",
    "udp_p99_us": "p99 us",
    "udp_max_us": "max us",
    "brake_udp_p50_ms": "brake UDP ms",
    "brake_udp_max_ms": "worst",
    "brake_ros_p50_ms": "brake ROS ms",
    "brake_ros_max_ms": "worst",
    "brakes_missing": "no brake",
    "lost": "lost",
    "stale": "stale",
    "cpu_us": "CPU us",
    "noise": "noise",
}
"""Metric -> what stands above it in the table."""


class Round(NamedTuple):
    """One fresh process under one pressure. `pressed` shows that there was some; `invalid` says why it is void."""

    metrics: Metrics
    pressed: Mapping[str, float]
    invalid: Sequence[str]


class Row(NamedTuple):
    """A subject under one pressure: the median, minimum and maximum of each metric, and what is made of them.

    `ratio` is p99 to that of the same subject alone, `versus` to that of the other subject; None where it is unknown.
    `missed` are the aims that are not met, `invalid` what is wrong with the rounds.
    """

    values: Mapping[str, Spread]
    ratio: float | None
    versus: float | None
    missed: Sequence[str]
    invalid: Sequence[str]


def aims(pressure: str, subjects: Sequence[str]) -> list[Aim]:
    """What the file of results says of each subject under a pressure."""
    most = MOST_BRAKE_MS.get(pressure, MOST_BRAKE_MS_ELSE)
    limits = {P99: MOST_US, **dict.fromkeys(BRAKES, most), "brakes_missing": 0.0}
    return [Aim(metric, of=subject, at_most=limit) for subject in subjects for metric, limit in limits.items()]


def quantiles(values: Sequence[float], names: Mapping[str, float]) -> Metrics:
    """Some quantiles by name, of values that need not be in order; nothing if there are none."""
    ordered = sorted(values)
    if not ordered:
        return {}
    return {name: round(float(ordered[round((len(ordered) - 1) * part)]), 4) for name, part in names.items()}


def row(pressure: str, rounds: Sequence[Round], alone: Sequence[Round] = (), other: Sequence[Round] = ()) -> Row:
    """`alone` are the rounds of the same subject without pressure, `other` those of the one that it is compared to."""
    values = _spreads(rounds)
    ratio, versus = _ratio(rounds, alone), _ratio(rounds, other)
    most = MOST_BRAKE_MS.get(pressure, MOST_BRAKE_MS_ELSE)
    missed = [f"{name} {values[name].max:.1f}" for name in BRAKES if name in values and values[name].max > most]
    if pressure == "busy":
        if versus is not None and versus > 1:
            missed.append(f"p99 {versus:.2f} of the other")
    elif pressure != ALONE:
        if ratio is not None and ratio > MOST_RATIO:
            missed.append(f"p99 {ratio:.2f} of alone")
        if P99 in values and values[P99].median > MOST_US:
            missed.append(f"p99 {values[P99].median:.0f} us")
    if "brakes_missing" in values and values["brakes_missing"].max:
        missed.append(f"{values['brakes_missing'].max:g} without a brake")
    return Row(values, ratio, versus, missed, [*dict.fromkeys(why for one in rounds for why in one.invalid)])


def _spreads(rounds: Sequence[Round]) -> dict[str, Spread]:
    names = dict.fromkeys(name for one in rounds for name in one.metrics)
    return {name: spread([one.metrics[name] for one in rounds if name in one.metrics]) for name in names}


def _ratio(ours: Sequence[Round], theirs: Sequence[Round]) -> float | None:
    """Of the medians of p99; None where one of them is not known."""
    above, below = (_spreads(rounds).get(P99) for rounds in (ours, theirs))
    return round(above.median / below.median, 3) if above and below and below.median else None


def text(subject: str, rows: Mapping[str, Row]) -> str:
    """A table for people: medians, the ratio to alone, and what is missed."""
    heads = [f"{subject:<15}", *(f"{title:>13}" for title in COLUMNS.values()), f"{'p99/alone':>10}{'p99/other':>10}"]
    lines = ["".join(heads)]
    for pressure, one in rows.items():
        cells = [f"{one.values[name].median:13.6g}" if name in one.values else f"{'-':>13}" for name in COLUMNS]
        ratios = [f"{value:10.2f}" if value is not None else f"{'-':>10}" for value in (one.ratio, one.versus)]
        lines.append("".join([f"{pressure:<15}", *cells, *ratios, "  ", verdict(one)]))
    return "\n".join(lines)


def verdict(one: Row) -> str:
    """`met`, or what is missed or makes the figures void."""
    if one.invalid:
        return f"INVALID: {'; '.join(one.invalid)}"
    return f"missed: {'; '.join(one.missed)}" if one.missed else "met"

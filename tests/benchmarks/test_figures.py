"""Medians, ratios and verdicts."""

from __future__ import annotations

import pytest

from benchmarks.versus.figures import Aim, Spread, judge, ratio, spreads


def test_a_metric_is_the_median_of_its_rounds_with_their_range() -> None:
    assert spreads([{"cpu": 3.0}, {"cpu": 1.0}, {"cpu": 10.0}]) == {"cpu": Spread(3, 1, 10)}


def test_a_metric_that_a_round_lacks_is_left_out() -> None:
    assert spreads([{"cpu": 3.0, "p99": 1.0}, {"cpu": 1.0}]) == {"cpu": Spread(2, 1, 3)}


def test_a_ratio_is_that_of_the_medians_and_its_range_that_of_the_pairs() -> None:
    ours = [{"cpu": 10.0}, {"cpu": 12.0}, {"cpu": 20.0}]
    theirs = [{"cpu": 10.0}, {"cpu": 8.0}, {"cpu": 10.0}]
    assert ratio("cpu", ours, theirs) == Spread(1.2, 1.0, 2.0)


@pytest.mark.parametrize("theirs", [{}, {"cpu": 0.0}])
def test_there_is_no_ratio_to_what_was_not_measured(theirs: dict[str, float]) -> None:
    assert ratio("cpu", [{"cpu": 1.0}], [theirs]) is None


@pytest.mark.parametrize(
    ("aim", "verdict"),
    [
        (Aim("cpu@5", "peer", at_most=1.5), "met"),
        (Aim("cpu@5", "peer", at_most=1.49), "missed"),
        (Aim("cpu@5", "peer", at_least=1.5), "met"),
        (Aim("cpu@5", "peer", at_least=1.6), "missed"),
        (Aim("cpu@5", "peer"), ""),
        (Aim("cpu@5", at_most=3), "met"),
        (Aim("cpu@5", at_most=2), "missed"),
    ],
)
def test_aims_are_met_up_to_their_limit(aim: Aim, verdict: str) -> None:
    [judged] = judge([aim], {"router": [{"cpu@5": 3.0}], "peer": [{"cpu@5": 2.0}]})
    assert judged.verdict == verdict


@pytest.mark.parametrize("loser", ["router", "peer"])
@pytest.mark.parametrize("what", ["lost", "ros_lost", "too_slow", "not_overloaded"])
def test_a_figure_does_not_count_where_something_was_missing(loser: str, what: str) -> None:
    rounds = {name: [{"cpu@5": 3.0, "cpu@9": 3.0, f"{what}@5": float(name == loser)}] for name in ("router", "peer")}
    aims = [Aim("cpu@5", "peer", at_most=2), Aim("cpu@5", "peer"), Aim("cpu@9", "peer", at_most=2)]
    assert [judged.verdict for judged in judge(aims, rounds)] == ["void", "void", "met"]


def test_what_was_not_measured_is_not_judged() -> None:
    assert judge([Aim("cpu@9", "peer", at_most=1)], {"router": [{"cpu@5": 3.0}], "peer": [{"cpu@5": 3.0}]}) == []

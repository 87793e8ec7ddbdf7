"""Which of several runs counts, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.versus.runs import Run, best
from benchmarks.versus.trial import Metrics

SOUND = Run(1000, 1000, lost=0, ros_lost=0, cpu_us=10, noise=0, latency_us=None)
SLOW = replace(SOUND, achieved=969)
LOSSY = replace(SOUND, lost=3)
NOISY = replace(SOUND, noise=0.2)


@pytest.mark.parametrize("bad", [SLOW, LOSSY, NOISY, replace(SOUND, ros_lost=1)])
def test_a_run_that_does_not_count_is_repeated_until_one_does(bad: Run) -> None:
    runs = iter([bad, bad, SOUND])
    assert best(lambda: next(runs), retries=4) is SOUND
    assert not list(runs)


def test_a_sound_run_is_not_repeated() -> None:
    runs = iter([SOUND])
    assert best(lambda: next(runs), retries=4) is SOUND


def test_where_none_is_sound_noise_is_the_least_evil() -> None:
    runs = iter([SLOW, LOSSY, NOISY, SLOW])
    assert best(lambda: next(runs), retries=3) is NOISY


def test_slow_and_lossy_runs_add_up() -> None:
    metrics: Metrics = {}
    for run in (SLOW, SLOW, LOSSY):
        run.add_to(metrics, "@5")
    assert metrics == {"noise": 0, "lost@5": 3, "ros_lost@5": 0, "too_slow@5": 2}

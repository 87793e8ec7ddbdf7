"""Every series has a index of its own from the start, and the histogram counts each duration once."""

from __future__ import annotations

import pytest

from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import (
    DROP_REASONS,
    HISTOGRAM_CELLS,
    METRICS,
    REJECT_REASONS,
    UNKNOWN_CASE,
    Counters,
    Series,
    metric,
)
from router.errors import ConfigurationError


def test_asking_twice_gives_the_same_slot() -> None:
    counters = Counters()
    assert counters.index("datagrams_received", "a") == counters.index("datagrams_received", "a") == 0
    assert counters.index("datagrams_received", "b") == 1
    assert counters.fresh_counts() == [0, 0]


def test_histogram_takes_a_run_of_slots() -> None:
    counters = Counters()
    first = counters.index("route_duration_seconds", "a")
    assert counters.index("route_duration_seconds", "b") == first + HISTOGRAM_CELLS
    assert counters.size == 2 * HISTOGRAM_CELLS


def test_wrong_number_of_labels_is_a_mistake_of_ours() -> None:
    with pytest.raises(ValueError, match="labels"):
        Counters().index("datagrams_rejected", "a")


def test_more_counters_than_there_is_room_for_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("router.compiler.metrics.MOST_COUNTERS", 2)
    counters = Counters()
    counters.index("datagrams_rejected", "a", "empty")
    counters.index("datagrams_rejected", "b", "empty")
    with pytest.raises(ConfigurationError, match="more than 2 counters"):
        counters.index("datagrams_rejected", "c", "empty")


def test_metric_names_are_unique() -> None:
    assert [metric(one.name) for one in METRICS] == list(METRICS)


def test_rover_has_every_series_before_the_first_datagram(rover_program: CompiledTable) -> None:
    series = dict(rover_program.counters.series())
    taken = [index + cell for each, index in series.items() for cell in range(_cells(each))]
    assert sorted(taken) == list(range(rover_program.counters.size))
    for listener in rover_program.listeners:
        for reason in REJECT_REASONS:
            assert Series("datagrams_rejected", (listener.name, reason)) in series
    for case in (*rover_program.envelopes.first.cases, UNKNOWN_CASE):
        assert Series("unhandled", (case,)) in series
    for [plan] in rover_program.inbound.values():
        route = plan.route
        for target in plan.targets:
            delivered = "messages_published" if target.is_topic else "datagrams_sent"
            assert Series(delivered, (route, target.label)) in series
            assert Series("messages_filtered", (route, target.label)) in series
            assert all(Series("messages_dropped", (route, target.label, reason)) in series for reason in DROP_REASONS)
        for name in ("route_duration_seconds", "route_silence_seconds"):
            assert Series(name, (route,)) in series


def _cells(series: Series) -> int:
    return HISTOGRAM_CELLS if metric(series.metric).kind == "histogram" else 1


def test_runs_of_new_series_are_known_before_anything_is_counted_in_them() -> None:
    first = Counters()
    first.index("datagrams_received", "rover")
    then = first.continued()
    then.index("datagrams_received", "rover")
    timed, new = then.index("route_duration_seconds", "drive"), then.index("datagrams_received", "arm")
    found = {(run.start, run.stop) for run in then.new_runs(first)}
    assert found == {(timed, timed + HISTOGRAM_CELLS), (new, new + 1)}


def test_books_that_continue_others_keep_what_was_counted() -> None:
    first = Counters()
    sent, gone = first.index("datagrams_received", "rover"), first.index("datagrams_received", "arm")
    unused, active = first.index("datagrams_padded", "arm"), first.index("deadman_active", "drive")
    timed = first.index("route_duration_seconds", "drive")
    counts = first.fresh_counts()
    counts[sent], counts[gone], counts[active] = 3, 4, 1
    then = first.continued()
    assert then.index("datagrams_received", "rover") == sent
    new = then.index("datagrams_received", "new")
    then.grow(counts)
    assert (counts[sent], counts[new]) == (3, 0)
    then.settle([counts])
    kept = {series.labels for series, _ in then.series()}
    assert kept == {("rover",), ("arm",), ("new",)}  # counters that counted stay, gauges and what is at 0 go
    assert counts[active] == 0
    last = then.continued()
    size = len(last.fresh_counts())
    assert {last.index("datagrams_padded", "x"), last.index("datagrams_padded", "y")} == {unused, active}
    assert last.index("route_duration_seconds", "x") == timed
    assert len(last.fresh_counts()) == size
    assert {series.metric for series, _ in first.series()} >= {
        "deadman_active",
        "route_duration_seconds",
    }  # as they were


def test_what_is_said_of_a_route_that_is_gone_stays() -> None:
    """Its series stay as well, and would be others with another label."""
    first = Counters()
    first.set_commands("drive", "board", are_commands=True)
    first.set_commands("arm", "board", are_commands=True)
    then = first.continued()
    then.set_commands("arm", "board", are_commands=False)
    assert (then.are_commands("drive", "board"), then.are_commands("arm", "board")) == (True, False)
    assert first.are_commands("arm", "board")

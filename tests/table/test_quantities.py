"""What is written of a number is read as the same number, and as a person writes it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.table import quantities, units


@pytest.mark.parametrize(
    ("ns", "text"),
    [
        (500_000_000, "500 ms"),
        (1_500_000_000, "1.5 s"),
        (90 * 10**9, "90 s"),
        (600 * 10**9, "10 min"),
        (7200 * 10**9, "2 h"),
        (1_250_000, "1.25 ms"),
        (1_000_000_001, "1.000000001 s"),
        (7, "7 ns"),
    ],
)
def test_durations_read_as_a_person_writes_them(ns: int, text: str) -> None:
    assert quantities.duration(ns) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [(4 << 20, "4 MiB"), (8 << 30, "8 GiB"), (1_500_000_000, "1500 MB"), (64_000, "64 kB"), (1400, "1400 B")],
)
def test_sizes_read_as_a_person_writes_them(count: int, text: str) -> None:
    assert quantities.disk_size(count) == text


@pytest.mark.parametrize(
    ("hertz", "text"), [(30.0, "30 Hz"), (0.5, "0.5 Hz"), (33.3, "33.3 Hz"), (1e-7, "0.0000001 Hz")]
)
def test_rates_read_as_a_person_writes_them(hertz: float, text: str) -> None:
    assert quantities.rate(hertz) == text


def test_what_has_no_number_is_a_word() -> None:
    assert (quantities.duration_or_never(0), quantities.period(0), quantities.topic_rate(0)) == (
        "never",
        "each",
        "each",
    )


_DURATIONS = st.integers(1, units.MAX_DURATION)
_ROUND = st.builds(
    lambda count, unit: count * unit, st.integers(1, 999), st.sampled_from([10**3, 10**6, 10**9, 6 * 10**10])
)


@pytest.mark.parametrize(
    ("write", "parse", "values"),
    [
        (quantities.duration, units.parse_duration, _DURATIONS | _ROUND),
        (quantities.duration_or_never, units.parse_patience, st.just(0) | _DURATIONS),
        (quantities.duration_or_never, units.parse_coalesce, st.integers(0, units.MAX_COALESCE)),
        (quantities.period, units.parse_period, st.just(0) | st.integers(units.MIN_PERIOD, units.MAX_DURATION)),
        (quantities.size, units.parse_size, st.integers(1, units.MAX_SIZE)),
        (quantities.size, units.parse_size, st.integers(1, 1023).map(lambda count: count << 20)),
        (quantities.disk_size, units.parse_disk_size, st.integers(units.MIN_DISK_SIZE, 10**15 - 1)),
        (quantities.disk_size, units.parse_disk_size, st.integers(1, 1 << 20).map(lambda count: count << 30)),
        (quantities.size, units.parse_datagram_size, st.integers(units.MIN_DATAGRAM, units.LARGEST_DATAGRAM)),
        (quantities.size, units.parse_message_size, st.integers(units.MIN_MESSAGE, units.MAX_MESSAGE)),
        (quantities.data_rate, units.parse_data_rate, st.integers(1, units.MAX_DATA_RATE)),
        (quantities.rate, units.parse_rate, st.integers(1, 10**9).map(lambda number: number / 1000)),
        (quantities.topic_rate, units.parse_topic_rate, st.just(0) | st.integers(units.MIN_PERIOD, 10**12)),
    ],
)
def test_what_is_written_is_read_as_the_same(
    write: Callable[[float], str], parse: Callable[[str], float], values: st.SearchStrategy[float]
) -> None:
    @given(values)
    def holds(value: float) -> None:
        assert parse(write(value)) == value

    holds()

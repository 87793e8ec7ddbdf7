"""Numbers with units: parsed exactly or refused, and written so that they are parsed as the same number."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.table import units


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("500ms", 500_000_000),
        ("1.5 s", 1_500_000_000),
        ("7ns", 7),
        ("0.1us", 100),
        ("2min", 120 * 10**9),
        ("1h", 3600 * 10**9),
    ],
)
def test_durations_are_exact(text: str, nanoseconds: int) -> None:
    assert units.parse_duration(text) == nanoseconds


@pytest.mark.parametrize(
    ("text", "size"), [("4MiB", 4 << 20), ("64kB", 64_000), ("64 KiB", 65_536), ("1.5MB", 1_500_000), ("9B", 9)]
)
def test_sizes_are_exact(text: str, size: int) -> None:
    assert units.parse_size(text) == size


@pytest.mark.parametrize(("text", "rate"), [("500kB/s", 500_000), ("1 MiB/s", 1 << 20), ("0.5kB/s", 500), ("9B/s", 9)])
def test_data_rates_are_exact(text: str, rate: int) -> None:
    assert units.parse_data_rate(text) == rate


@pytest.mark.parametrize(("value", "hertz"), [("30 Hz", 30.0), ("0.5Hz", 0.5), (10, 10.0), (0.25, 0.25)])
def test_rates_are_numbers_or_carry_their_unit(value: str | float, hertz: float) -> None:
    assert units.parse_rate(value) == hertz


@pytest.mark.parametrize(("text", "nanoseconds"), [("1ms", 1_000_000), ("250 us", 250_000), ("never", 0)])
def test_coalescing_may_be_never(text: str, nanoseconds: int) -> None:
    assert units.parse_coalesce(text) == nanoseconds


@pytest.mark.parametrize(("text", "nanoseconds"), [("500ms", 500_000_000), ("1ms", 1_000_000), ("each", 0)])
def test_a_period_may_be_each(text: str, nanoseconds: int) -> None:
    assert units.parse_period(text) == nanoseconds


@pytest.mark.parametrize(
    ("value", "nanoseconds"),
    [("50 Hz", 20_000_000), ("0.5Hz", 2 * 10**9), (1000, 1_000_000), (3, 333_333_333), ("each", 0)],
)
def test_a_topics_rate_is_a_period(value: str | float, nanoseconds: int) -> None:
    assert units.parse_topic_rate(value) == nanoseconds


def test_an_interval_and_sizes_of_messages_have_bounds() -> None:
    assert units.parse_interval("10ms") == 10_000_000
    assert [units.parse_datagram_size(text) for text in ("576B", "65507B")] == [576, 65507]
    assert [units.parse_message_size(text) for text in ("1kB", "256MiB")] == [1000, 256 << 20]


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (units.parse_duration, "500"),
        (units.parse_duration, "5 parsecs"),
        (units.parse_duration, "-1s"),
        (units.parse_duration, "0s"),
        (units.parse_duration, "0.5ns"),
        (units.parse_duration, "999999999999999h"),
        (units.parse_duration, "1e3s"),
        (units.parse_coalesce, "0ms"),
        (units.parse_coalesce, "11ms"),
        (units.parse_coalesce, "off"),
        (units.parse_size, "4"),
        (units.parse_size, "4Mib"),
        (units.parse_size, "0B"),
        (units.parse_size, "1.5B"),
        (units.parse_size, "1024MiB"),
        (units.parse_size, "64kB/s"),
        (units.parse_data_rate, "64kB"),
        (units.parse_data_rate, "64 kbit/s"),
        (units.parse_data_rate, "0kB/s"),
        (units.parse_data_rate, "0.5B/s"),
        (units.parse_data_rate, "999999999999999MB/s"),
        (units.parse_period, "999us"),
        (units.parse_period, "never"),
        (units.parse_interval, "9.9ms"),
        (units.parse_interval, "each"),
        (units.parse_datagram_size, "575B"),
        (units.parse_datagram_size, "65508B"),
        (units.parse_message_size, "999B"),
        (units.parse_message_size, "257MiB"),
        (units.parse_topic_rate, 1001),
        (units.parse_topic_rate, "1001 Hz"),
        (units.parse_topic_rate, 1e-12),
        (units.parse_topic_rate, 0),
        (units.parse_topic_rate, "never"),
        (units.parse_rate, "30"),
        (units.parse_rate, "0 Hz"),
        (units.parse_rate, 0),
        (units.parse_rate, float("inf")),
        (units.parse_rate, float("nan")),
    ],
)
def test_what_means_nothing_is_refused(parse: Callable[[object], object], text: object) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse(text)


@pytest.mark.parametrize(("text", "size"), [("4GiB", 4 << 30), ("1.5 GB", 1_500_000_000), ("1MiB", 1 << 20)])
def test_sizes_of_files_are_exact(text: str, size: int) -> None:
    assert units.parse_disk_size(text) == size


def test_a_file_has_at_least_a_mebibyte() -> None:
    with pytest.raises(ValueError, match="at least 1048576"):
        units.parse_disk_size("10kB")


def test_patience_may_have_no_end() -> None:
    assert (units.parse_patience("5s"), units.parse_patience("never")) == (5 * 10**9, 0)


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
    assert units.duration(ns) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [(4 << 20, "4 MiB"), (8 << 30, "8 GiB"), (1_500_000_000, "1500 MB"), (64_000, "64 kB"), (1400, "1400 B")],
)
def test_sizes_read_as_a_person_writes_them(count: int, text: str) -> None:
    assert units.disk_size(count) == text


@pytest.mark.parametrize(
    ("hertz", "text"), [(30.0, "30 Hz"), (0.5, "0.5 Hz"), (33.3, "33.3 Hz"), (1e-7, "0.0000001 Hz")]
)
def test_rates_read_as_a_person_writes_them(hertz: float, text: str) -> None:
    assert units.rate(hertz) == text


def test_what_has_no_number_is_a_word() -> None:
    assert (units.duration_or_never(0), units.period(0), units.topic_rate(0)) == (
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
        (units.duration, units.parse_duration, _DURATIONS | _ROUND),
        (units.duration_or_never, units.parse_patience, st.just(0) | _DURATIONS),
        (units.duration_or_never, units.parse_coalesce, st.integers(0, units.MAX_COALESCE)),
        (units.period, units.parse_period, st.just(0) | st.integers(units.MIN_PERIOD, units.MAX_DURATION)),
        (units.size, units.parse_size, st.integers(1, units.MAX_SIZE)),
        (units.size, units.parse_size, st.integers(1, 1023).map(lambda count: count << 20)),
        (units.disk_size, units.parse_disk_size, st.integers(units.MIN_DISK_SIZE, 10**15 - 1)),
        (units.disk_size, units.parse_disk_size, st.integers(1, 1 << 20).map(lambda count: count << 30)),
        (units.size, units.parse_datagram_size, st.integers(units.MIN_DATAGRAM, units.LARGEST_DATAGRAM)),
        (units.size, units.parse_message_size, st.integers(units.MIN_MESSAGE, units.MAX_MESSAGE)),
        (units.data_rate, units.parse_data_rate, st.integers(1, units.MAX_DATA_RATE)),
        (units.rate, units.parse_rate, st.integers(1, 10**9).map(lambda number: number / 1000)),
        (units.topic_rate, units.parse_topic_rate, st.just(0) | st.integers(units.MIN_PERIOD, 10**12)),
    ],
)
def test_what_is_written_is_read_as_the_same(
    write: Callable[[float], str], parse: Callable[[str], float], values: st.SearchStrategy[float]
) -> None:
    @given(values)
    def holds(value: float) -> None:
        assert parse(write(value)) == value

    holds()

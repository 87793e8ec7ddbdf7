from __future__ import annotations

from collections.abc import Callable

import pytest

from router.table.units import (
    parse_coalesce,
    parse_data_rate,
    parse_datagram_size,
    parse_disk_size,
    parse_duration,
    parse_interval,
    parse_message_size,
    parse_patience,
    parse_period,
    parse_rate,
    parse_size,
    parse_topic_rate,
)


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
    assert parse_duration(text) == nanoseconds


@pytest.mark.parametrize(
    ("text", "size"), [("4MiB", 4 << 20), ("64kB", 64_000), ("64 KiB", 65_536), ("1.5MB", 1_500_000), ("9B", 9)]
)
def test_sizes_are_exact(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize(("text", "rate"), [("500kB/s", 500_000), ("1 MiB/s", 1 << 20), ("0.5kB/s", 500), ("9B/s", 9)])
def test_data_rates_are_exact(text: str, rate: int) -> None:
    assert parse_data_rate(text) == rate


@pytest.mark.parametrize(("value", "hertz"), [("30 Hz", 30.0), ("0.5Hz", 0.5), (10, 10.0), (0.25, 0.25)])
def test_rates_are_numbers_or_carry_their_unit(value: str | float, hertz: float) -> None:
    assert parse_rate(value) == hertz


@pytest.mark.parametrize(("text", "nanoseconds"), [("1ms", 1_000_000), ("250 us", 250_000), ("never", 0)])
def test_coalescing_may_be_never(text: str, nanoseconds: int) -> None:
    assert parse_coalesce(text) == nanoseconds


@pytest.mark.parametrize(("text", "nanoseconds"), [("500ms", 500_000_000), ("1ms", 1_000_000), ("each", 0)])
def test_a_period_may_be_each(text: str, nanoseconds: int) -> None:
    assert parse_period(text) == nanoseconds


@pytest.mark.parametrize(
    ("value", "nanoseconds"),
    [("50 Hz", 20_000_000), ("0.5Hz", 2 * 10**9), (1000, 1_000_000), (3, 333_333_333), ("each", 0)],
)
def test_a_topics_rate_is_a_period(value: str | float, nanoseconds: int) -> None:
    assert parse_topic_rate(value) == nanoseconds


def test_an_interval_and_sizes_of_messages_have_bounds() -> None:
    assert parse_interval("10ms") == 10_000_000
    assert [parse_datagram_size(text) for text in ("576B", "65507B")] == [576, 65507]
    assert [parse_message_size(text) for text in ("1kB", "256MiB")] == [1000, 256 << 20]


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (parse_duration, "500"),
        (parse_duration, "5 parsecs"),
        (parse_duration, "-1s"),
        (parse_duration, "0s"),
        (parse_duration, "0.5ns"),
        (parse_duration, "999999999999999h"),
        (parse_duration, "1e3s"),
        (parse_coalesce, "0ms"),
        (parse_coalesce, "11ms"),
        (parse_coalesce, "off"),
        (parse_size, "4"),
        (parse_size, "4Mib"),
        (parse_size, "0B"),
        (parse_size, "1.5B"),
        (parse_size, "1024MiB"),
        (parse_size, "64kB/s"),
        (parse_data_rate, "64kB"),
        (parse_data_rate, "64 kbit/s"),
        (parse_data_rate, "0kB/s"),
        (parse_data_rate, "0.5B/s"),
        (parse_data_rate, "999999999999999MB/s"),
        (parse_period, "999us"),
        (parse_period, "never"),
        (parse_interval, "9.9ms"),
        (parse_interval, "each"),
        (parse_datagram_size, "575B"),
        (parse_datagram_size, "65508B"),
        (parse_message_size, "999B"),
        (parse_message_size, "257MiB"),
        (parse_topic_rate, 1001),
        (parse_topic_rate, "1001 Hz"),
        (parse_topic_rate, 1e-12),
        (parse_topic_rate, 0),
        (parse_topic_rate, "never"),
        (parse_rate, "30"),
        (parse_rate, "0 Hz"),
        (parse_rate, 0),
        (parse_rate, float("inf")),
        (parse_rate, float("nan")),
    ],
)
def test_what_means_nothing_is_refused(parse: Callable[[object], object], text: object) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse(text)


@pytest.mark.parametrize(("text", "size"), [("4GiB", 4 << 30), ("1.5 GB", 1_500_000_000), ("1MiB", 1 << 20)])
def test_sizes_of_files_are_exact(text: str, size: int) -> None:
    assert parse_disk_size(text) == size


def test_a_file_has_at_least_a_mebibyte() -> None:
    with pytest.raises(ValueError, match="at least 1048576"):
        parse_disk_size("10kB")


def test_patience_may_have_no_end() -> None:
    assert (parse_patience("5s"), parse_patience("never")) == (5 * 10**9, 0)

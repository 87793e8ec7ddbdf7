"""Numbers with units: parsed exactly or refused, and shown so that they are parsed as the same number."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.table import units
from router.table.units import (
    DATA_RATE,
    DATAGRAM_SIZE,
    DISK_SIZE,
    DURATION,
    INTERVAL,
    MESSAGE_SIZE,
    PATIENCE,
    PERIOD,
    RATE,
    SIZE,
    TOPIC_RATE,
    Quantity,
)


@pytest.mark.parametrize(
    ("quantity", "texts"),
    [
        (DURATION, {"500ms": 500_000_000, "1.5 s": 1_500_000_000, "7ns": 7, "0.1us": 100, "2min": 120 * 10**9,
                    "1h": 3600 * 10**9}),
        (SIZE, {"4MiB": 4 << 20, "64kB": 64_000, "64 KiB": 65_536, "1.5MB": 1_500_000, "9B": 9}),
        (DATA_RATE, {"500kB/s": 500_000, "1 MiB/s": 1 << 20, "0.5kB/s": 500, "9B/s": 9}),
        (RATE, {"30 Hz": 30.0, "0.5Hz": 0.5, 10: 10.0, 0.25: 0.25}),
        (PERIOD, {"500ms": 500_000_000, "1ms": 1_000_000, "each": 0}),
        (TOPIC_RATE, {"50 Hz": 20_000_000, "0.5Hz": 2 * 10**9, 1000: 1_000_000, 3: 333_333_333, "each": 0}),
        (INTERVAL, {"10ms": 10_000_000}),
        (DATAGRAM_SIZE, {"576B": 576, "65507B": 65507}),
        (MESSAGE_SIZE, {"1kB": 1000, "256MiB": 256 << 20}),
        (DISK_SIZE, {"4GiB": 4 << 30, "1.5 GB": 1_500_000_000, "1MiB": 1 << 20}),
        (PATIENCE, {"5s": 5 * 10**9, "never": None}),
    ],
)  # fmt: skip
def test_numbers_are_parsed_exactly(quantity: Quantity, texts: dict[object, object]) -> None:
    assert {text: quantity.parse(text) for text in texts} == texts


@pytest.mark.parametrize(
    ("quantity", "texts"),
    [
        (DURATION, ["500", "5 parsecs", "-1s", "0s", "0.5ns", "999999999999999h", "1e3s"]),
        (SIZE, ["4", "4Mib", "0B", "1.5B", "1024MiB", "64kB/s"]),
        (DATA_RATE, ["64kB", "64 kbit/s", "0kB/s", "0.5B/s", "999999999999999MB/s"]),
        (PERIOD, ["999us", "never"]),
        (INTERVAL, ["9.9ms", "each"]),
        (DATAGRAM_SIZE, ["575B", "65508B"]),
        (MESSAGE_SIZE, ["999B", "257MiB"]),
        (DISK_SIZE, ["10kB"]),
        (TOPIC_RATE, [1001, "1001 Hz", 1e-12, 0, "never"]),
        (RATE, ["30", "0 Hz", 0, float("inf"), float("nan")]),
    ],
)
def test_what_means_nothing_is_refused(quantity: Quantity, texts: list[object]) -> None:
    for text in texts:
        with pytest.raises(ValueError, match=r"\w"):
            quantity.parse(text)


@pytest.mark.parametrize(
    ("quantity", "texts"),
    [
        (DURATION, {500_000_000: "500 ms", 1_500_000_000: "1.5 s", 90 * 10**9: "90 s", 600 * 10**9: "10 min",
                    7200 * 10**9: "2 h", 1_250_000: "1.25 ms", 1_000_000_001: "1.000000001 s", 7: "7 ns"}),
        (DISK_SIZE, {4 << 20: "4 MiB", 8 << 30: "8 GiB", 1_500_000_000: "1500 MB", 64_000: "64 kB", 1400: "1400 B"}),
        (DATA_RATE, {500_000: "500 kB/s"}),
        (RATE, {30.0: "30 Hz", 0.5: "0.5 Hz", 33.3: "33.3 Hz", 1e-7: "0.0000001 Hz"}),
        (PERIOD, {0: "each"}),
        (TOPIC_RATE, {0: "each"}),
    ],
)  # fmt: skip
def test_numbers_are_shown_as_a_person_writes_them(quantity: Quantity, texts: dict[float, str]) -> None:
    assert {value: quantity.show(value) for value in texts} == texts


@pytest.mark.parametrize(
    ("quantity", "texts"),
    [
        (DURATION, {"1,5s": "1.5s", "200µs": "200us", "200 MS": "200ms", "1s500ms": "1.5 s", "1m30s": "90 s",
                    "5m": "5min", "1day": "24h", "10 Hz": "100 ms", ".5 sec": "0.5s", "1e3ms": "1000ms",
                    "2 seconds": "2s"}),
        (RATE, {"5/s": "5 Hz", "10ms": "100 Hz", "20hz": "20 Hz", "1 kHz": "1000 Hz", "3 per second": "3 Hz"}),
        (SIZE, {"4M": "4MB' or '4MiB", "64K": "64kB' or '64KiB", "4 mib": "4MiB", "4MB/s": "4MB"}),
        (DATA_RATE, {"500kB": "500kB/s", "500 kbps": "62.5kB/s", "1Mbit/s": "0.125MB/s", "2m": "2MB/s' or '2MiB/s"}),
    ],
)  # fmt: skip
def test_the_quantity_of_the_kind_that_was_meant_is_suggested(quantity: Quantity, texts: dict[str, str]) -> None:
    for text, meant in texts.items():
        with pytest.raises(ValueError, match=r"\w") as raised:
            quantity.parse(text)
        assert str(raised.value).partition("; ")[2] == f"did you mean '{meant}'?"


@pytest.mark.parametrize(
    "text", ["5 parsecs", "0x5s", "4", "s", "1s5", "1e999999999s", "9" * 99 + "s", "never", "5 Hz 3 MB"]
)
def test_what_could_be_anything_has_no_suggestion(text: str) -> None:
    assert units.meant_quantity(text, lambda _: True) == ""


_DURATIONS = st.integers(1, units.MAX_DURATION)
_ROUND = st.builds(
    lambda count, unit: count * unit, st.integers(1, 999), st.sampled_from([10**3, 10**6, 10**9, 6 * 10**10])
)


@pytest.mark.parametrize(
    ("quantity", "values"),
    [
        (DURATION, _DURATIONS | _ROUND),
        (PATIENCE, st.none() | _DURATIONS),
        (PERIOD, st.just(0) | st.integers(units.MIN_PERIOD, units.MAX_DURATION)),
        (SIZE, st.integers(1, units.MAX_SIZE) | st.integers(1, 1023).map(lambda count: count << 20)),
        (DISK_SIZE, st.integers(units.MIN_DISK_SIZE, 10**15 - 1)),
        (DISK_SIZE, st.integers(1, 1 << 20).map(lambda count: count << 30)),
        (DATAGRAM_SIZE, st.integers(units.MIN_DATAGRAM, units.LARGEST_DATAGRAM)),
        (MESSAGE_SIZE, st.integers(units.MIN_MESSAGE, units.MAX_MESSAGE)),
        (DATA_RATE, st.integers(1, units.MAX_DATA_RATE)),
        (RATE, st.integers(1, 10**9).map(lambda number: number / 1000)),
        (TOPIC_RATE, st.just(0) | st.integers(units.MIN_PERIOD, 10**12)),
    ],
)
def test_what_is_shown_is_parsed_as_the_same(quantity: Quantity, values: st.SearchStrategy[float | None]) -> None:
    @given(values)
    def holds(value: float | None) -> None:
        assert quantity.parse(quantity.show(value)) == value

    holds()

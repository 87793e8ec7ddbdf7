from __future__ import annotations

import pytest

from router.table.compose import resolve, surprise
from router.table.nodes import Plain


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("null", None),
        ("true", True),
        ("FALSE", False),
        ("10", 10),
        ("-3", -3),
        ("0", 0),
        ("0x1F", 31),
        ("1.5", 1.5),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("y", "y"),
        (".inf", ".inf"),
        (".nan", ".nan"),
        ("1" * 5000, "1" * 5000),
        ("accel_x", "accel_x"),
        ("192.168.0.30:8", "192.168.0.30:8"),
    ],
)
def test_plain_scalars_mean_what_yaml_1_2_says(text: str, value: Plain) -> None:
    found = resolve(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "text",
    [
        *("yes", "Yes", "YES", "no", "On", "OFF", "~"),
        *("0777", "010", "08", "-017", "0o17", "0b101", "+0b1", "-0x1F", "0x_1F", "0x1_F"),
        *("12:30", "1:2:3.5", "40:8", "1_000", "1_0.5", "1.5_0", "1_0e3"),
        *("2026-11-21", "2026-1-2", "2026-11-21T10:00:00Z", "2026-11-21 10:00:00.5 +01:00"),
    ],
)
def test_what_yaml_1_1_reads_differently_is_a_surprise(text: str) -> None:
    assert surprise(text)


@pytest.mark.parametrize(
    "text",
    [
        *("y", "n", "x", "true", "null", "", "0", "10", "-1", "0x1F", "1.5", "1e3", "0.5", ".5"),
        *("127.0.0.1:8", "accel_x", "_1", "sensor_board", "1_a", "a:1", "1:60", "yes please", "2026", "-", "0.10"),
    ],
)
def test_what_everybody_reads_alike_is_none(text: str) -> None:
    assert surprise(text) is None

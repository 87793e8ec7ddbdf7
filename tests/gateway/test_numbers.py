"""Numbers are printed as the existing gateway's JSON library prints them, to the last digit."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.numbers import DOUBLES, FLOATS, double_text
from tests.oracles.reference_json import reference_number

GOLDEN = [
    line.split(" ") for line in Path(__file__).with_name("golden").joinpath("doubles.txt").read_text().splitlines()
]


def bits_of(number: float) -> int:
    (bits,) = struct.unpack("<Q", struct.pack("<d", number))
    return int(bits)


def number_of(bits: int) -> float:
    (number,) = struct.unpack("<d", struct.pack("<Q", bits))
    return float(number)


def test_every_golden_number_has_its_text() -> None:
    assert len(GOLDEN) > 3000
    assert [(bits, double_text(int(bits, 16))) for bits, _ in GOLDEN] == [(bits, text) for bits, text in GOLDEN]


def test_golden_numbers_are_not_all_printed_as_python_would() -> None:
    others = [bits for bits, text in GOLDEN if repr(number_of(int(bits, 16))) != text and text != "null"]
    assert len(others) > 1000


def test_the_oracle_has_the_golden_texts_too() -> None:
    some = GOLDEN[::10]
    assert [reference_number(number_of(int(bits, 16))) for bits, _ in some] == [text for _, text in some]


@given(st.integers(0, (1 << 64) - 1) | st.floats().map(bits_of) | st.floats(-1000, 1000, width=32).map(bits_of))
def test_any_number_is_printed_as_the_oracle_does(bits: int) -> None:
    assert double_text(bits) == DOUBLES[bits] == reference_number(number_of(bits))


@given(st.integers(0, (1 << 64) - 1).filter(lambda bits: math.isfinite(number_of(bits))))
def test_text_reads_back_as_the_number(bits: int) -> None:
    assert bits_of(float(double_text(bits))) == bits


@pytest.mark.parametrize("exponent", range(1, 2047, 5))
@pytest.mark.parametrize("fraction", [0, 1, (1 << 52) - 1], ids=["power of two", "next above", "next below"])
def test_numbers_beside_powers_of_two_are_printed_as_the_oracle_does(exponent: int, fraction: int) -> None:
    bits = exponent << 52 | fraction
    assert double_text(bits) == reference_number(number_of(bits))


@given(st.integers(0, (1 << 32) - 1))
def test_float32_is_widened(bits: int) -> None:
    (number,) = struct.unpack("<f", struct.pack("<I", bits))
    assert FLOATS[bits] == reference_number(number)


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0.1, "0.10000000149011612"),
        (1.0, "1.0"),
        (-0.0, "-0.0"),
        (1e15, "999999986991104.0"),
        (1e16, "1.0000000272564224e+16"),
        (math.inf, "null"),
        (-math.inf, "null"),
        (math.nan, "null"),
    ],
)
def test_well_known_float32(number: float, text: str) -> None:
    (bits,) = struct.unpack("<I", struct.pack("<f", number))
    assert FLOATS[bits] == text


def test_texts_that_are_kept_stay_few() -> None:
    for bits in range(20_000):
        assert DOUBLES[bits << 30]
    assert len(DOUBLES) <= 1 << 13

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.tools.fields import set_fields
from router.tools.show import compact, float_text, rate_text, words
from router.types.protobuf import PayloadCase

POINTS = st.builds(lambda x, y: {"x": x, "y": y}, st.integers(-(2**31), 2**31 - 1), st.integers(-5, 5))
MESSAGES = st.fixed_dictionaries(
    {},
    optional={
        "flag": st.booleans(),
        "i64": st.integers(-(2**63), 2**63 - 1),
        "u64": st.integers(0, 2**64 - 1),
        "single": st.floats(width=32, allow_nan=False),
        "real": st.floats(allow_nan=False),
        "text": st.text(),
        "blob": st.binary(),
        "mode": st.integers(-(2**31), 2**31 - 1),
        "point": POINTS,
        "numbers": st.lists(st.floats(width=32, allow_nan=False), max_size=5),
        "points": st.lists(POINTS, max_size=3),
        "maybe": st.integers(-1, 1),
    },
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=MESSAGES)
def test_what_is_shown_can_be_sent_again(every_kind: PayloadCase, values: dict[str, Any]) -> None:
    message = every_kind.message_class(**values)
    again = every_kind.message_class()
    set_fields(again, every_kind.type, list(words(message, every_kind.type)))
    assert again.SerializeToString() == message.SerializeToString()


def test_defaults_are_left_out(every_kind: PayloadCase) -> None:
    message = every_kind.message_class(flag=True, i32=0, mode=1, state=9, point={"x": 1}, numbers=[0.5, 0])
    line = compact(message, every_kind.type)
    assert line == "flag=true mode=MODE_ON state=9 point.x=1 numbers[0]=0.5 numbers[1]=0"
    assert compact(every_kind.message_class(), every_kind.type) == "(all default)"


def test_a_text_of_several_lines_stays_one_line(every_kind: PayloadCase) -> None:
    assert compact(every_kind.message_class(text="a\nb"), every_kind.type) == "'text=a\\nb'"


@given(st.floats(width=32, allow_nan=False))
def test_a_float_is_written_so_that_it_reads_back(value: float) -> None:
    assert struct.pack("<f", float(float_text(value, 32))) == struct.pack("<f", value)


@pytest.mark.parametrize(("rate", "text"), [(0, "0"), (0.51, "0.5"), (9.97, "10"), (49.7, "50"), (1234.5, "1234")])
def test_rates_are_short(rate: float, text: str) -> None:
    assert rate_text(rate) == text


def test_rounding_leaves_a_double_twice_the_digits() -> None:
    assert (float_text(51.099312345, 32, digits=4), float_text(51.099312345, 64, digits=4)) == ("51.1", "51.099312")
    assert float_text(float("nan"), 32, digits=4) == "nan"

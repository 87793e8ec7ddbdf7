from __future__ import annotations

import math
from typing import Any

import pytest

from router.errors import UsageError
from router.tools.fields import set_fields
from router.types.protobuf import PayloadCase


def build(case: PayloadCase, *words: str) -> Any:
    message = case.message_class()
    set_fields(message, case.type, words)
    return message


@pytest.mark.parametrize(
    ("word", "field", "value"),
    [
        ("flag=true", "flag", True),
        ("flag=OFF", "flag", False),
        ("i32=-5", "i32", -5),
        ("i32=0x10", "i32", 16),
        ("i64=-0x8000000000000000", "i64", -(2**63)),
        ("u64=18446744073709551615", "u64", 2**64 - 1),
        ("single=1.5", "single", 1.5),
        ("single=-inf", "single", -math.inf),
        ("single=3.4028235e+38", "single", 3.4028234663852886e38),
        ("real=1e300", "real", 1e300),
        ("text=a b=c", "text", "a b=c"),
        ("blob=0a1B", "blob", b"\x0a\x1b"),
        ("blob=", "blob", b""),
        ("mode=MODE_HALF", "mode", -2),
        ("mode=Mode.MODE_ON", "mode", 1),
        ("mode=77", "mode", 77),
        ("state=BUSY", "state", 1),
        ("state=State.BUSY", "state", 1),
        ("state=EveryKind.State.BUSY", "state", 1),
    ],
)
def test_a_word_sets_its_field(every_kind: PayloadCase, word: str, field: str, value: object) -> None:
    assert getattr(build(every_kind, word), field) == value


def test_nan_is_a_float(every_kind: PayloadCase) -> None:
    assert math.isnan(build(every_kind, "single=nan").single)


def test_nested_fields_are_reached_by_dots_and_make_the_message_present(every_kind: PayloadCase) -> None:
    message = build(every_kind, "point.x=3", "point.y=0")
    assert (message.point.x, message.HasField("point")) == (3, True)


def test_an_empty_value_makes_an_empty_message_present(every_kind: PayloadCase) -> None:
    assert build(every_kind, "point=").HasField("point")


def test_repeating_a_word_appends_to_a_list(every_kind: PayloadCase) -> None:
    assert list(build(every_kind, "numbers=1", "numbers=2.5").numbers) == [1, 2.5]


def test_an_index_sets_one_element_and_fills_what_is_before_it(every_kind: PayloadCase) -> None:
    message = build(every_kind, "numbers[2]=7", "numbers[0]=1", "modes[1]=MODE_ON", "points[1].y=4")
    assert list(message.numbers) == [1, 0, 7]
    assert list(message.modes) == [0, 1]
    assert [point.y for point in message.points] == [0, 4]


def test_later_words_win(every_kind: PayloadCase) -> None:
    assert build(every_kind, "i32=1", "i32=2").i32 == 2


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("flagg=1", "EveryKind has no field 'flagg'; did you mean 'flag'?"),
        ("point.z=1", "Point has no field 'z'; known: x, y"),
        ("flag", "'flag' is not an assignment; write flag=value"),
        ("flag=perhaps", "flag: 'perhaps' is not a bool; write true or false"),
        ("i32=1.5", "i32: '1.5' is not an integer (int32); write it as 42, -1 or 0x2a"),
        ("i32=2147483648", "i32: 2147483648 does not fit int32, which holds -2147483648 to 2147483647"),
        ("u32=-1", "u32: -1 does not fit uint32, which holds 0 to 4294967295"),
        ("single=fast", "single: 'fast' is not a number (float32); write it as 1.5, -2e3, nan or inf"),
        ("single=1e39", "single: 1e39 does not fit float32, which holds -3.4028235e+38 to 3.4028235e+38"),
        (
            "real=1e999",
            "real: 1e999 does not fit float64, which holds -1.7976931348623157e+308 to 1.7976931348623157e+308",
        ),
        ("mode=MODE_OM", "mode: Mode has no value 'MODE_OM'; did you mean 'MODE_ON'?"),
        ("mode=99999999999", "mode: 99999999999 does not fit int32, which holds -2147483648 to 2147483647"),
        ("blob=xyz", "blob: 'xyz' is not hex; write bytes as 0a1b2c"),
        ("point=3", "point is the message Point; set its fields, such as point.x=..."),
        ("flag.x=1", "flag of EveryKind is bool, it has no fields"),
        ("flag[0]=1", "flag[0]: flag is bool and no list"),
        ("points.x=1", "points.x: points is a list; say which element, such as points[0]"),
        ("numbers[99999]=1", "numbers[99999]: float32[] holds at most 65507 elements"),
        ("a b=1", "'a b' is not a field path; write it as x, bbox.x or points[0]"),
    ],
)
def test_a_wrong_word_is_explained_in_one_line(every_kind: PayloadCase, word: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        build(every_kind, word)
    assert str(caught.value) == complaint

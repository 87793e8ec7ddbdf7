"""Command-line words set fields, and printed words set them again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.datagrams import wire_of_protos
from router.errors import UsageError
from router.types.model import Field, Float, Int, List, MessageType, String
from router.types.protobuf import PayloadCase
from router.values.printing import (
    compact,
    protobuf_tree,
    words,
)
from router.values.reading import completed, members_of, payload
from tests import everything


def build(case: PayloadCase, *words: str) -> Any:
    return payload(case, words)


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


def test_nested_fields_are_reached_by_dots_and_make_the_message_present(every_kind: PayloadCase) -> None:
    message = build(every_kind, "point.x=3", "point.y=0")
    assert (message.point.x, message.HasField("point")) == (3, True)
    assert build(every_kind, "point=").HasField("point")


def test_lists_are_appended_to_or_set_by_index_and_later_words_win(every_kind: PayloadCase) -> None:
    assert list(build(every_kind, "numbers=1", "numbers=2.5").numbers) == [1, 2.5]
    message = build(every_kind, "numbers[2]=7", "numbers[0]=1", "modes[1]=MODE_ON", "points[1].y=4", "i32=1", "i32=2")
    assert list(message.numbers) == [1, 0, 7]
    assert list(message.modes) == [0, 1]
    assert [point.y for point in message.points] == [0, 4]
    assert message.i32 == 2
    assert math.isnan(build(every_kind, "single=nan").single)


def test_words_of_a_ros_message_are_completed_with_its_defaults() -> None:
    point = MessageType("p/msg/Point", (Field("x", Float(64)), Field("y", Float(64), default=2.0)))
    fields = Field("points", List(point)), Field("pair", List(Int(8, signed=True), length=2)), Field("name", String())
    kind = MessageType("p/msg/Shape", (*fields, Field("at", point)))
    assert completed(kind, members_of(kind, ["points[1].x=5", "pair=7"])) == {
        "points": [{"x": 0.0, "y": 2.0}, {"x": 5.0, "y": 2.0}],
        "pair": [7, 0],
        "name": "",
        "at": {"x": 0.0, "y": 2.0},
    }


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
        ("flag.x=1", "flag of EveryKind is bool, which has no fields"),
        ("flag[0]=1", "flag[0]: flag is bool, not a list"),
        (
            "numbers=[1,2]",
            (
                "numbers is a list, float32[], and '[1,2]' is no element of it; "
                "write each element: numbers[0]=... numbers[1]=..."
            ),
        ),
        (
            "points=3",
            (
                "points is a list, Point[], and '3' is no element of it; "
                "write each element: points[0].x=... points[1].x=..."
            ),
        ),
        ("points.x=1", "points.x: points is a list; name an element, such as points[0].x=..."),
        ("numbers[99999]=1", "numbers[99999]: float32[] holds at most 65507 elements"),
        (
            "a b=1",
            "'a b' is not a field path; write it as x, bbox.x, points[0] or counts[key]: elements count from 0",
        ),
    ],
)
def test_a_wrong_word_is_explained_in_one_line(every_kind: PayloadCase, word: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        build(every_kind, word)
    assert str(caught.value) == complaint


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


@given(values=MESSAGES)
def test_what_is_shown_can_be_sent_again(every_kind: PayloadCase, values: dict[str, Any]) -> None:
    message = every_kind.message_class(**values)
    again = payload(every_kind, list(words(protobuf_tree(message, every_kind.type))))
    assert again.SerializeToString() == message.SerializeToString()


@pytest.mark.parametrize("case", everything.wire().envelopes.first.cases)
def test_every_feature_of_protobuf_is_shown_so_that_it_can_be_sent_again(case: str) -> None:
    message, known = everything.payload(case), everything.wire().case(case)
    again = payload(known, [word for word in words(protobuf_tree(message, known.type)) if word != "="])
    assert again == message


PLAIN, OLD = (everything.wire().case(name) for name in ("plain", "old"))


def test_a_map_is_set_by_its_keys() -> None:
    keys = {"left": "1", "a.b": "2", 'x"]=[': "3", "": "4", "zażółć": "5"}
    message = build(PLAIN, *(f"by_text[{json.dumps(key)}]={value}" for key, value in keys.items()), "by_text[left]=9")
    assert dict(message.by_text) == {**keys, "left": "9"}
    message = build(PLAIN, "by_i32[-5].speed=2", "by_i32[0x7]=", "by_flag[yes].speed=1")
    assert {key: value.speed for key, value in message.by_i32.items()} == {-5: 2, 7: 0}
    assert message.by_flag[True].speed == 1
    assert compact(message, PLAIN.type) == "by_i32[-5].speed=2 by_i32[7]= by_flag[true].speed=1"


@pytest.mark.parametrize(
    ("case", "word", "complaint"),
    [
        (PLAIN, "by_text=x", "by_text is a map; name a value, such as by_text[key]=..."),
        (PLAIN, "by_text.left=x", "by_text is a map; name a value, such as by_text[left]=..."),
        (PLAIN, "by_i32.speed=1", "by_i32.speed: by_i32 is a map; name an element, such as by_i32[key].speed=..."),
        (PLAIN, "by_i32[left]=", "by_i32[left]: 'left' is not an integer (int32); write it as 42, -1 or 0x2a"),
        (PLAIN, 'by_text["\\q"]=1', """by_text["\\q"]: "\\q" is not a key: Invalid \\escape; quote it as in JSON"""),
        (PLAIN, "singles[left]=1", "singles[left]: 'left' is not an index; elements are numbered from 0"),
        (OLD, "closed=0", "closed: old.Closed has no value '0'; known: CLOSED_LESS, CLOSED_ONE, CLOSED_TWO"),
    ],
)
def test_a_wrong_word_for_a_map_or_a_closed_enum_is_explained(case: PayloadCase, word: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        build(case, word)
    assert str(caught.value) == complaint


def test_a_message_without_fields_has_an_example_too(tmp_path: Path) -> None:
    (tmp_path / "kinds.proto").write_text(
        'syntax = "proto3"; message Nothing {} message Kind { repeated Nothing nothings = 1; }'
        "message PBEnvelope { oneof payload { Kind kind = 1; } }"
    )
    with pytest.raises(UsageError, match="nothings is a list, Nothing"):
        build(wire_of_protos(tmp_path).case("kind"), "nothings=3")


def test_the_last_member_of_a_oneof_is_set() -> None:
    message = build(PLAIN, "chosen_text=a", "chosen_motor.speed=1", "chosen_flag=yes", "chosen_text=b")
    assert compact(message, PLAIN.type) == "chosen_text=b"


def test_a_list_of_a_closed_enum_is_extended_with_its_first_value() -> None:
    assert list(build(OLD, "some[1]=CLOSED_TWO").some) == [1, 2]

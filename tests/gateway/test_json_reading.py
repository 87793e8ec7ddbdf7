"""A message's JSON becomes the bytes that the reference writes, or is refused with the field's path."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.gateway.json_code import json_writer
from router.gateway.json_reading import InvalidMessageError, cdr_builder, example, parse_json
from router.gateway.style import PLACEHOLDER, Style
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.ros import ros_interfaces
from tests.compiler.generated_types import defaults
from tests.compiler.reading import messages
from tests.gateway.client_json import FORMS, tree, values, written
from tests.oracles.reference import initial
from tests.oracles.reference_cdr import cdr

BYTE = Int(8, signed=False)


def message(**fields: Type) -> MessageType:
    return MessageType("made/msg/Made", tuple(Field(name, type_) for name, type_ in fields.items()))


def build(declared: MessageType, text: str | bytes, style: Style = Style.PLAIN) -> bytes:
    return cdr_builder(declared, style)(parse_json(text.encode() if isinstance(text, str) else text))


def refusal(declared: MessageType, value: Any, style: Style = Style.PLAIN) -> str:
    with pytest.raises(InvalidMessageError) as caught:
        cdr_builder(declared, style)(value)
    return str(caught.value)


def known(name: str) -> MessageType:
    found = ros_interfaces().get(name)
    assert found is not None
    return found


TWIST = known("geometry_msgs/msg/Twist")


@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data(), st.sampled_from(Style), st.sampled_from(FORMS))
def test_any_message_is_written_as_the_reference_does(data: st.DataObject, style: Style, form: dict[str, Any]) -> None:
    declared = data.draw(messages())
    value = data.draw(values(declared))
    text = written(tree(declared, value, is_wrapped=style is Style.WRAPPED), form)
    assert build(declared, text, style) == cdr(declared, value)


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data())
def test_example_is_accepted_and_has_the_defaults(data: st.DataObject) -> None:
    made = data.draw(messages(depth=1))
    declared = MessageType(
        made.name,
        tuple(Field(field.name, field.type, default=data.draw(_json_defaults(field.type))) for field in made.fields),
    )
    text = json.dumps(example(declared), allow_nan=False)
    expected = {field.name: initial(field.type, field.default) for field in declared.fields}
    assert build(declared, text) == cdr(declared, expected)


def _json_defaults(declared: Type) -> st.SearchStrategy[Any]:
    """Those of strings have no NUL, and their bound counts what ROS counts; no number is NaN."""
    innermost = declared.element if isinstance(declared, List) else declared
    return st.none() if isinstance(innermost, String) else defaults(declared).filter(_is_finite)


def _is_finite(value: Any) -> bool:
    return all(math.isfinite(each) for each in (value if isinstance(value, list) else [value or 0]))


def test_example_shows_declared_defaults() -> None:
    inside = MessageType("made/msg/Inside", (Field("number", BYTE, default=7), Field("nothing", message())))
    declared = MessageType(
        "made/msg/Made",
        (
            Field("text", String(), default="it is"),
            Field("wide", String(wide=True)),
            Field("yes", Bool(), default=True),
            Field("three", List(Int(16, signed=True), length=3), default=(1, -2, 3)),
            Field("some", List(Float(64)), default=(1.5,)),
            Field("none", List(Float(64))),
            Field("two", List(inside, length=2)),
            Field("limit", Float(64), default=math.inf),
        ),
    )
    shown = example(declared)
    assert shown == {
        "text": "it is", "wide": "", "yes": True, "three": [1, -2, 3], "some": [1.5], "none": [],
        "two": [{"number": 7, "nothing": {}}] * 2, "limit": 0.0,
    }  # fmt: skip
    assert build(declared, json.dumps(shown))


INT8, UINT64, FLOAT32, FLOAT64 = Int(8, signed=True), Int(64, signed=False), Float(32), Float(64)
UNFIT: list[tuple[Type, str, str]] = [
    (BYTE, "-1", "-1 is outside of uint8, 0 to 255"),
    (BYTE, "256", "256 is outside of uint8, 0 to 255"),
    (BYTE, "3.0", "3.0 is no integer"),
    (BYTE, "1e2", "100.0 is no integer"),
    (BYTE, "true", "true is no integer"),
    (BYTE, "null", "null is no integer"),
    (BYTE, '"7"', "'7' is no integer"),
    (BYTE, "[7]", "a list is no integer"),
    (INT8, "128", "128 is outside of int8, -128 to 127"),
    (INT8, "-129", "-129 is outside of int8, -128 to 127"),
    (UINT64, "18446744073709551616", "is outside of uint64, 0 to 18446744073709551615"),
    (Int(64, signed=True), "-9223372036854775809", "is outside of int64, -9223372036854775808 to 9223372036854775807"),
    (FLOAT32, "1e308", "1e+308 is outside of float32"),
    (FLOAT32, "-3.5e38", "-3.5e+38 is outside of float32"),
    (FLOAT32, "3.4028235677973366e38", "is outside of float32"),
    (FLOAT32, "null", "null is no number"),
    (FLOAT64, "false", "false is no number"),
    (FLOAT64, '"abc"', "'abc' is no number"),
    (FLOAT64, '{"x":1}', "an object is no number"),
    (Bool(), "1", "1 is neither true nor false"),
    (Bool(), "0.0", "0.0 is neither true nor false"),
    (Bool(), "null", "null is neither true nor false"),
    (String(), "5", "5 is no string"),
    (String(), '"a\\u0000b"', "a string of ROS holds no NUL"),
    (String(bound=3), '"\u00e9\u00e9"', "4 bytes are more than 3"),
    (String(wide=True), "[97]", "a list is no string"),
    (String(wide=True, bound=1), '"\N{GRINNING FACE}"', "2 characters are more than 1"),
    (MessageType("made/msg/Inside", (Field("x", BYTE),)), "5", "5 is no made/msg/Inside"),
    (MessageType("made/msg/Inside", (Field("x", BYTE),)), "[]", "a list is no made/msg/Inside"),
    (MessageType("made/msg/Nothing"), '{"x":1}', "'x' is no field of made/msg/Nothing"),
    (MessageType("made/msg/Nothing"), "[]", "a list is no made/msg/Nothing"),
]


@pytest.mark.parametrize(("declared", "text", "expected"), UNFIT)
def test_unfit_value_is_refused(declared: Type, text: str, expected: str) -> None:
    value = parse_json(text.encode())
    assert refusal(message(field=declared), {"field": value}).startswith("field: ")
    assert refusal(message(field=declared), {"field": value}).endswith(expected)
    if not (isinstance(declared, String) and declared.wide):
        assert refusal(message(field=declared), {"field": [value]}, Style.WRAPPED).endswith(expected)
    for before in (0, 1, 9000):
        good = initial(declared)
        listed = {"field": [good] * before + [value, good, value]}
        assert refusal(message(field=List(declared)), listed).startswith(f"field[{before}]: ")


def test_numbers_beyond_a_double_are_refused_whoever_parsed_them() -> None:
    for value in (math.nan, math.inf, -math.inf, 10**400, -(10**5000)):
        assert len(refusal(message(x=FLOAT64), {"x": value})) < 60
        assert refusal(message(x=List(FLOAT32)), {"x": [1.0, value]}).startswith("x[1]: ")
        assert len(refusal(message(x=BYTE), {"x": value})) < 60


def test_largest_numbers_are_taken() -> None:
    declared = message(a=FLOAT32, b=FLOAT64, c=UINT64, d=INT8, e=FLOAT64, f=FLOAT32)
    value: dict[str, Any] = {
        "a": 3.4028234663852886e38,
        "b": 1.7976931348623157e308,
        "c": 2**64 - 1,
        "d": -128,
        "e": 10**24,
        "f": 3,
    }
    assert build(declared, json.dumps(value)) == cdr(declared, value)


def test_refusals_name_the_path() -> None:
    zero = {"x": 0, "y": 0, "z": 0}
    assert refusal(TWIST, {"linear": zero | {"x": "abc"}, "angular": zero}) == "linear.x: 'abc' is no number"
    assert refusal(TWIST, {"linear": zero}) == "angular: is missing"
    assert refusal(TWIST, {"linear": {"x": 1, "z": 1}, "angular": zero}) == "linear.y: is missing"
    assert (
        refusal(TWIST, {"linear": zero | {"w": 1}, "angular": zero})
        == "linear: 'w' is no field of geometry_msgs/msg/Vector3"
    )
    assert refusal(TWIST, zero) == "'x' is no field of geometry_msgs/msg/Twist"
    assert refusal(TWIST, None) == "null is no geometry_msgs/msg/Twist"
    wrapped = {"x": [0], "y": [0], "z": [0]}
    assert (
        refusal(TWIST, {"linear": [wrapped], "angular": [zero]}, Style.WRAPPED)
        == "angular.x: 0 instead of a list of one"
    )
    assert (
        refusal(TWIST, {"linear": [wrapped, wrapped], "angular": [wrapped]}, Style.WRAPPED)
        == "linear: 2 elements instead of a list of one"
    )
    covariance = known("geometry_msgs/msg/PoseWithCovariance")
    short = example(covariance) | {"covariance": [0.0] * 35}
    assert refusal(covariance, short) == "covariance: 35 elements instead of 36"
    array = known("geometry_msgs/msg/PoseArray")
    pose = {"position": zero, "orientation": zero | {"w": 1}}
    poses = [pose, pose, {"position": zero, "orientation": zero | {"w": None}}]
    assert refusal(array, example(array) | {"poses": poses}) == "poses[2].orientation.w: null is no number"
    assert refusal(message(a=List(BYTE, bound=2)), {"a": [1, 2, 3]}) == "a: 3 elements are more than 2"
    assert refusal(message(a=List(BYTE, bound=2)), {"a": {}}) == "a: an object is no list"
    assert refusal(message(a=List(String())), {"a": ["", 5]}) == "a[1]: 5 is no string"


def test_refusals_repeat_little_of_what_was_sent() -> None:
    long = "\x1b[2J\n\ud800" + "x" * 100_000
    zero = {"x": 0, "y": 0, "z": 0}
    for value in ({long: 1}, long, {"linear": zero | {"x": long}, "angular": zero}, {"linear": zero, long: {}}):
        reason = refusal(TWIST, value)
        assert len(reason) < 150
        assert reason.isascii()
        assert reason.isprintable()


def test_wide_text_of_units_is_checked() -> None:
    declared = message(text=String(wide=True), many=List(String(wide=True, bound=3)))

    def wrapped(text: Any, *many: Any) -> dict[str, Any]:
        return {"text": [text], "many": [*many]}

    smiling = [0xD83D, 0xDE00]
    assert cdr_builder(declared, Style.WRAPPED)(wrapped([104, *smiling], [], smiling)) == cdr(
        declared, {"text": "h\N{GRINNING FACE}", "many": ["", "\N{GRINNING FACE}"]}
    )
    for value, expected in (
        (wrapped("ab"), "text: 'ab' is no list of UTF-16 code units"),
        (wrapped([65536]), "text[0]: 65536 is outside of uint16, 0 to 65535"),
        (wrapped([97, -1]), "text[1]: -1 is outside of uint16, 0 to 65535"),
        (wrapped([97, True]), "text[1]: true is no integer"),
        (wrapped([97, 0xD83D]), "text: the string has half of a surrogate pair"),
        (wrapped([0xDE00, 0xD83D]), "text: the string has half of a surrogate pair"),
        (wrapped([], [97, "b"]), "many[0][1]: 'b' is no integer"),
        (wrapped([], [97] * 4), "many[0]: 4 characters are more than 3"),
    ):
        assert refusal(declared, value, Style.WRAPPED) == expected
    long = "a\N{GRINNING FACE}" * 5000
    assert build(declared, json.dumps({"text": long, "many": []})) == cdr(declared, {"text": long, "many": []})


@pytest.mark.parametrize("style", Style)
def test_message_without_fields_may_have_the_one_of_rosidl(style: Style) -> None:
    declared = message(before=BYTE, nothing=message(), many=List(message()), after=FLOAT64)
    is_wrapped = style is Style.WRAPPED
    expected = cdr(declared, {"before": 1, "nothing": {}, "many": [{}, {}], "after": 2.0})
    for nothing in ({}, {PLACEHOLDER: [0] if is_wrapped else 0}):
        value = {"before": 1, "nothing": nothing, "many": [nothing, nothing], "after": 2.0}
        if is_wrapped:
            value |= {"before": [1], "nothing": [nothing], "after": [2.0]}
        assert cdr_builder(declared, style)(value) == expected
    assert build(message(), "{}", style) == b"\x00\x01\x00\x00\x00"
    bad = {PLACEHOLDER: [256] if is_wrapped else 256}
    assert refusal(message(), bad, style) == f"{PLACEHOLDER}: 256 is outside of uint8, 0 to 255"


def test_long_lists_are_written_as_short_ones() -> None:
    declared = message(first=BYTE, data=List(BYTE), values=List(FLOAT64), flags=List(Bool()), last=Int(32, signed=True))
    for count in (4095, 4096, 4097, 12_289):
        value: dict[str, Any] = {
            "first": 1,
            "data": [index % 256 for index in range(count)],
            "values": [index / 7 for index in range(count)],
            "flags": [index % 3 == 0 for index in range(count)],
            "last": -1,
        }
        assert build(declared, json.dumps(value)) == cdr(declared, value)


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data(), st.sampled_from(Style))
def test_what_a_gateway_sends_another_takes(data: st.DataObject, style: Style) -> None:
    declared = data.draw(messages())
    sent = cdr(declared, data.draw(values(declared)))
    assert build(declared, json_writer(declared, style)(sent), style) == sent

"""A message's JSON becomes the bytes that the reference writes, or is refused with the field's path."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.gateway.json_codec import InvalidMessageError, decoder, encoder
from router.gateway.json_types import PLACEHOLDER, Style, example
from router.gateway.packets import PacketError
from router.rehearsal.cdr import serialize as cdr
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.ros import ros_interfaces
from tests.compiler.generated_types import defaults
from tests.compiler.reading import messages
from tests.gateway.client_json import FORMS, tree, values, written
from tests.oracles.reference import initial

BYTE = Int(8, signed=False)


def message(**fields: Type) -> MessageType:
    return MessageType("made/msg/Made", tuple(Field(name, type_) for name, type_ in fields.items()))


def build(declared: MessageType, text: str | bytes, style: Style = Style.PLAIN) -> bytes:
    return decoder(declared, style)(text.encode() if isinstance(text, str) else text)


def refusal(declared: MessageType, value: Any, style: Style = Style.PLAIN) -> str:
    """Why a value is refused, or the text of one."""
    text = value if isinstance(value, bytes) else json.dumps(value).encode()
    with pytest.raises((InvalidMessageError, PacketError)) as caught:
        decoder(declared, style)(text)
    return str(caught.value)


def known(name: str) -> MessageType:
    found = ros_interfaces().get(name)
    assert found is not None
    return found


TWIST = known("geometry_msgs/msg/Twist")


@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data(), st.sampled_from(Style), st.sampled_from(FORMS))
def test_any_message_is_written_as_the_reference_does(data: st.DataObject, style: Style, form: dict[str, Any]) -> None:
    declared = data.draw(messages())
    value = data.draw(values(declared))
    text = written(tree(declared, value, is_wrapped=style is Style.WRAPPED), form)
    assert build(declared, text, style) == cdr(declared, value)


@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
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
INSIDE = MessageType("made/msg/Inside", (Field("x", BYTE),))
UNFIT: list[tuple[Type, str, str]] = [
    (BYTE, "-1", "Expected `int` >= 0"),
    (BYTE, "256", "Expected `int` <= 255"),
    (BYTE, "3.0", "Expected `int`, got `float`"),
    (BYTE, "1e2", "Expected `int`, got `float`"),
    (BYTE, "true", "Expected `int`, got `bool`"),
    (BYTE, "null", "Expected `int`, got `null`"),
    (BYTE, '"7"', "Expected `int`, got `str`"),
    (BYTE, "[7]", "Expected `int`, got `array`"),
    (BYTE, "9" * 5000, "Integer value out of range"),
    (INT8, "128", "Expected `int` <= 127"),
    (INT8, "-129", "Expected `int` >= -128"),
    (UINT64, "-1", "Expected `int` >= 0"),
    (UINT64, "18446744073709551616", "18446744073709551616 is out of range for uint64"),
    (Int(64, signed=True), "-9223372036854775809", "Expected `int` >= -9223372036854775808"),
    (Int(64, signed=True), "9223372036854775808", "Expected `int` <= 9223372036854775807"),
    (FLOAT32, "1e308", "Expected `float` <= 3.4028235"),
    (FLOAT32, "-3.5e38", "Expected `float` >= -3.4028235"),
    (FLOAT32, "3.4028235677973366e38", "Expected `float` <= 3.4028235"),
    (FLOAT32, "null", "Expected `float`, got `null`"),
    (FLOAT64, "false", "Expected `float`, got `bool`"),
    (FLOAT64, '"abc"', "Expected `float`, got `str`"),
    (FLOAT64, '{"x":1}', "Expected `float`, got `object`"),
    (FLOAT64, "1e999", "Number out of range"),
    (FLOAT64, "-1E+309", "Number out of range"),
    (FLOAT64, "1" * 400, "Number out of range"),
    (Bool(), "1", "Expected `bool`, got `int`"),
    (Bool(), "0.0", "Expected `bool`, got `float`"),
    (Bool(), "null", "Expected `bool`, got `null`"),
    (String(), "5", "Expected `str`, got `int`"),
    (String(), '"a\\u0000b"', "a ROS string cannot contain NUL"),
    (String(bound=3), '"\u00e9\u00e9"', "4 bytes exceed the bound of 3"),
    (String(wide=True), "[97]", "Expected `str`, got `array`"),
    (String(wide=True, bound=1), '"\N{GRINNING FACE}"', "2 characters exceed the bound of 1"),
    (INSIDE, "5", "Expected `object`, got `int`"),
    (INSIDE, "[]", "Expected `object`, got `array`"),
    (MessageType("made/msg/Nothing"), '{"x":1}', "Object contains unknown field `x`"),
    (MessageType("made/msg/Nothing"), "[]", "Expected `object`, got `array`"),
]


@pytest.mark.parametrize(("declared", "text", "expected"), UNFIT)
def test_unfit_value_is_refused_and_its_place_named(declared: Type, text: str, expected: str) -> None:
    reason = refusal(message(field=declared), b'{"field":%b}' % text.encode())
    assert expected in reason
    assert "field" in reason
    if not (isinstance(declared, String) and declared.wide):
        assert expected in refusal(message(field=declared), b'{"field":[%b]}' % text.encode(), Style.WRAPPED)
    for before in (0, 1):
        good = json.dumps(initial(declared))
        listed = ",".join([good] * before + [text, good, text])
        reason = refusal(message(field=List(declared)), b'{"field":[%b]}' % listed.encode())
        assert expected in reason
        assert "field[" in reason


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


ZERO = {"x": 0, "y": 0, "z": 0}
POSE = {"position": ZERO, "orientation": ZERO | {"w": 1}}
ARRAY, COVARIANCE = known("geometry_msgs/msg/PoseArray"), known("geometry_msgs/msg/PoseWithCovariance")
POSES = [POSE, POSE, {"position": ZERO, "orientation": ZERO | {"w": None}}]


@pytest.mark.parametrize(
    ("declared", "value", "expected"),
    [
        (TWIST, {"linear": ZERO | {"x": "abc"}, "angular": ZERO}, "Expected `float`, got `str` - at `$.linear.x`"),
        (TWIST, {"linear": ZERO}, "Object missing required field `angular`; send every field of the message"),
        (
            TWIST,
            {"linear": {"x": 1, "z": 1}, "angular": ZERO},
            "Object missing required field `y` - at `$.linear`; send every field of the message",
        ),
        (
            TWIST,
            {"linear": ZERO | {"w": 1}, "angular": ZERO},
            "Object contains unknown field `w` - at `$.linear`",
        ),
        (TWIST, ZERO, "Object contains unknown field `x`"),
        (TWIST, None, "Expected `object`, got `null`"),
        (
            COVARIANCE,
            example(COVARIANCE) | {"covariance": [0.0] * 35},
            "Expected `array` of length >= 36 - at `$.covariance`",
        ),
        (
            COVARIANCE,
            example(COVARIANCE) | {"covariance": [0.0] * 37},
            "Expected `array` of length <= 36 - at `$.covariance`",
        ),
        (ARRAY, example(ARRAY) | {"poses": POSES}, "Expected `float`, got `null` - at `$.poses[2].orientation.w`"),
        (message(a=List(BYTE, bound=2)), {"a": [1, 2, 3]}, "Expected `array` of length <= 2 - at `$.a`"),
        (message(a=List(BYTE, bound=2)), {"a": {}}, "Expected `array`, got `object` - at `$.a`"),
        (message(a=List(String())), {"a": ["", 5]}, "Expected `str`, got `int` - at `$.a[1]`"),
        (message(a=List(String())), {"a": ["", "\0"]}, "a[]: a ROS string cannot contain NUL"),
        (message(b=message(a=String(bound=1))), {"b": {"a": "xy"}}, "b.a: 2 bytes exceed the bound of 1"),
    ],
)
def test_refusals_name_the_path(declared: MessageType, value: Any, expected: str) -> None:
    assert refusal(declared, value) == expected


def test_wrapped_values_are_in_lists_of_one() -> None:
    wrapped = {"x": [0], "y": [0], "z": [0]}
    assert decoder(TWIST, Style.WRAPPED)(json.dumps({"linear": [wrapped], "angular": [wrapped]}).encode())
    for value, expected in (
        ({"linear": [wrapped], "angular": [ZERO]}, "Expected `array`, got `int` - at `$.angular[0].x`"),
        ({"linear": [wrapped, wrapped], "angular": [wrapped]}, "Expected `array` of length 1 - at `$.linear`"),
        ({"linear": [], "angular": [wrapped]}, "Expected `array` of length 1 - at `$.linear`"),
        ({"linear": wrapped, "angular": [wrapped]}, "Expected `array`, got `object` - at `$.linear`"),
    ):
        assert refusal(TWIST, value, Style.WRAPPED) == expected


def test_refusals_repeat_little_of_what_was_sent() -> None:
    long = "\x1b[2J\n" + "x" * 100_000
    for value in ({long: 1}, long, {"linear": ZERO | {"x": long}, "angular": ZERO}, {"linear": ZERO, long: {}}):
        reason = refusal(TWIST, value)
        assert len(reason) < 150
        assert reason.isascii()
        assert reason.isprintable()


BAD = [
    b"", b" \n", b"nothing", b"\xef\xbb\xbf{}", b'{"a":"\xff"}', b'{"a":"\xed\xa0\x80"}', b'{"a":"x\\ud800y"}',
    b'{"a":"x\\udfffy"}', b'{"\\uDFFF":"","a":""}', b'{"a":"b', b'{"a":"a\nb"}', b'{"a":"\\x41"}', b'{"a":""', b'{"a"}',
    b"{1:2}", b'{"a":"",}', b'{"a":""} {}', b'{"a":""}]', b'{"a":""]', b'{"a":NaN}', b'{"a":-Infinity}', b'{"a":01}',
    b"[" * 100_000, b'{"a":' * 100_000, b'{"b":' + b"[" * 100_000,
]  # fmt: skip


def test_bad_text_is_refused_in_one_sentence() -> None:
    for text in BAD:
        assert 0 < len(refusal(message(a=String()), text)) < 120


def test_wide_text_of_units_is_checked() -> None:
    declared = message(text=String(wide=True), many=List(String(wide=True, bound=3)))

    def wrapped(text: Any, *many: Any) -> dict[str, Any]:
        return {"text": [text], "many": [*many]}

    smiling = [0xD83D, 0xDE00]
    assert build(declared, json.dumps(wrapped([104, *smiling], [], smiling)), Style.WRAPPED) == cdr(
        declared, {"text": "h\N{GRINNING FACE}", "many": ["", "\N{GRINNING FACE}"]}
    )
    for value, expected in (
        (wrapped("ab"), "Expected `array`, got `str` - at `$.text[0]`"),
        (wrapped([65536]), "Expected `int` <= 65535 - at `$.text[0][0]`"),
        (wrapped([97, -1]), "Expected `int` >= 0 - at `$.text[0][1]`"),
        (wrapped([97, True]), "Expected `int`, got `bool` - at `$.text[0][1]`"),
        (wrapped([97, 0xD83D]), "text: the string has an unpaired surrogate"),
        (wrapped([0xDE00, 0xD83D]), "text: the string has an unpaired surrogate"),
        (wrapped([], [97, "b"]), "Expected `int`, got `str` - at `$.many[0][1]`"),
        (wrapped([], [97] * 4), "Expected `array` of length <= 3 - at `$.many[0]`"),
    ):
        assert refusal(declared, value, Style.WRAPPED) == expected
    long = "a\N{GRINNING FACE}" * 5000
    assert build(declared, json.dumps({"text": long, "many": []})) == cdr(declared, {"text": long, "many": []})


@pytest.mark.parametrize("style", Style)
def test_message_without_fields_may_have_the_one_of_rosidl(style: Style) -> None:
    declared = message(before=BYTE, nothing=message(), many=List(message()), after=FLOAT64)
    is_wrapped = style is Style.WRAPPED
    expected = cdr(declared, {"before": 1, "nothing": {}, "many": [{}, {}], "after": 2.0})
    for nothing in ({}, {PLACEHOLDER.name: [0] if is_wrapped else 0}):
        value = {"before": 1, "nothing": nothing, "many": [nothing, nothing], "after": 2.0}
        if is_wrapped:
            value |= {"before": [1], "nothing": [nothing], "after": [2.0]}
        assert build(declared, json.dumps(value), style) == expected
    assert build(message(), "{}", style) == b"\x00\x01\x00\x00\x00"
    bad = {PLACEHOLDER.name: [256] if is_wrapped else 256}
    assert PLACEHOLDER.name in refusal(message(), bad, style)


@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data(), st.sampled_from(Style))
def test_what_a_gateway_sends_another_takes(data: st.DataObject, style: Style) -> None:
    declared = data.draw(messages())
    sent = cdr(declared, data.draw(values(declared)))
    assert build(declared, encoder(declared, style)(sent), style) == sent


def test_a_field_may_be_called_as_a_keyword_of_python() -> None:
    declared = MessageType("made/msg/Made", (Field("from", BYTE), Field("class", String())))
    assert build(declared, '{"from":7,"class":"x"}') == cdr(declared, {"from": 7, "class": "x"})

"""The language of docs/reference/table.md by example: what an expression gives, and why it is refused."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from router.rehearsal.cdr import deserialize
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.comparing import same
from tests.compiler.compiling import compiled, field_map, scope_of, serializer
from tests.compiler.machine import FAILURES, NonFiniteError

I64, U64, U32 = Int(64, signed=True), Int(64, signed=False), Int(32, signed=False)
MODE = Enum("Mode", (("OFF", 0), ("ON", 1)))
SOURCE = MessageType(
    "Source",
    (
        Field("i", I64), Field("u", U64), Field("x", Float(64)), Field("f", Float(32)), Field("flag", Bool()),
        Field("name", String()), Field("mode", MODE), Field("data", Bytes()),
        Field("many", List(U32)), Field("signed", List(I64)), Field("large", List(U64)), Field("names", List(String())),
        Field("floats", List(Float(64))), Field("other", List(Float(64))),
        Field("pair", List(Int(8, signed=True), length=2)), Field("from", U32), Field("in", U32),
    ),
)  # fmt: skip
GIVEN: dict[str, Any] = {
    "i": -7, "u": 5, "x": 2.5, "f": 0.5, "flag": True, "name": "left", "mode": 1, "data": b"\x01\xff",
    "many": [150, 275], "signed": [-1, 2], "large": [1, 2], "floats": [0.5, -1.5], "other": [10.0, 20.0],
    "pair": [3, -4], "names": ["a", "b"], "from": 8, "in": 9,
}  # fmt: skip
LARGEST, LOWEST, UNSIGNED = (1 << 63) - 1, -(1 << 63), (1 << 64) - 1


def value(text: str, **given: Any) -> Any:
    _, evaluate = compiled(text, scope_of(SOURCE, [MODE]))
    return evaluate(SimpleNamespace(**{**GIVEN, **given}))


@pytest.mark.parametrize(
    ("text", "given", "expected"),
    [
        ("i + u", {"i": LARGEST, "u": 0}, LARGEST),
        ("u + u", {"u": 1 << 62}, 1 << 63),
        ("u - u", {"u": UNSIGNED}, 0),
        ("i // 2", {"i": -7}, -4),
        ("i % 5", {"i": -7}, 3),
        ("i ** 3", {"i": -7}, -343),
        ("-i", {"i": LARGEST}, -LARGEST),
        ("-u", {"u": 1 << 63}, LOWEST),
        ("abs(i)", {"i": LOWEST}, 1 << 63),
        ("i / u", {"i": (1 << 53) + 1, "u": 1}, float(1 << 53)),
        ("u / 3", {"u": UNSIGNED}, float(1 << 64) / 3.0),
        ("i < u", {"i": -1, "u": UNSIGNED}, True),
        ("u > x", {"u": (1 << 53) + 1, "x": float(1 << 53)}, True),
        ("i == x", {"i": LARGEST, "x": float(1 << 63)}, False),
        ("round(x)", {"x": 2.5}, 2),
        ("round(x)", {"x": -9.3e18 + 1e17}, -9200000000000000000),
        ("round(u)", {"u": UNSIGNED}, UNSIGNED),
        ("wrap(i, -180, 179)", {"i": 190}, -170),
        ("seconds(received_at)", {}, 1_700_000_000_123_456_789.0 / 1e9),
        ("text(x, 2)", {"x": 2.675}, "2.67"),
        ("text(x, 0)", {"x": 2.5}, "2"),
        ("text(i, 1)", {"i": -7}, "-7.0"),
        ("text(x, 3)", {"x": -math.inf}, "-inf"),
        ("text(x, 3)", {"x": math.nan}, "nan"),
        ("text(f, 17)", {"f": 0.5}, "0.50000000000000000"),
        ("str(u) + str(flag) + str(mode)", {"u": UNSIGNED}, f"{UNSIGNED}True1"),
        ("message.from + message.in", {}, 17),
    ],
)
def test_value_of_scalars(text: str, given: dict[str, Any], expected: object) -> None:
    found = value(text, **given)
    assert type(found) is type(expected)
    assert same(found, expected)


@pytest.mark.parametrize(
    ("text", "given", "expected"),
    [
        ("many / 100", {}, [1.5, 2.75]),
        ("many + pair", {}, [153, 271]),
        ("1 - floats", {}, [0.5, 2.5]),
        ("-floats", {}, [-0.5, 1.5]),
        ("floats * other", {}, [5.0, -30.0]),
        ("floats * other + many", {}, [155.0, 245.0]),
        ("radians(other)", {}, [math.radians(10.0), math.radians(20.0)]),
        ("round(floats)", {}, [0, -2]),
        ("clamp(many, 200, 250)", {}, [200, 250]),
        ("max(floats, 0)", {}, [0.5, 0.0]),
        ("min(many, large)", {}, [1, 2]),
        ("'wheel_' + str(many)", {}, ["wheel_150", "wheel_275"]),
        ("names + name", {}, ["aleft", "bleft"]),
        ("text(floats, 1)", {}, ["0.5", "-1.5"]),
        ("[i, u] * 2", {}, [-14, 10]),
        ("[i, u] + pair", {}, [-4, 1]),
        ("data // 2", {}, [0, 127]),
        ("many * 2 if flag else many", {}, [300, 550]),
        ("many / 0.5", {"many": []}, []),
        ("many // i", {"many": [], "i": 0}, []),
        ("(many / 100)[1]", {}, 2.75),
        ("len(many * 2)", {}, 2),
        ("len(floats + other)", {"floats": [], "other": []}, 0),
        ("2.75 in many / 100", {}, True),
        ("x in floats", {"x": math.nan, "floats": [math.nan]}, False),
        ("x not in floats", {"x": math.nan, "floats": [math.nan]}, True),
        ("255 in data", {}, True),
        ("min(many)", {}, 150),
        ("max(floats)", {"floats": [math.nan, 5.0]}, math.nan),
        ("max(floats * 2)", {}, 1.0),
        ("min(data)", {}, 1),
        ("sum(many)", {}, 425),
        ("sum(many)", {"many": []}, 0),
        ("sum(pair)", {}, -1),
        ("sum(data)", {}, 256),
        ("sum(large)", {"large": [1 << 63, LARGEST]}, UNSIGNED),
        ("sum(signed)", {"signed": [LOWEST, LARGEST]}, -1),
        ("sum(floats)", {"floats": [1e16, 1.0, 1.0, -1e16]}, 0.0),
        ("sum(floats)", {"floats": []}, 0.0),
        ("sum(floats * other)", {}, -25.0),
        ("sum([i, u])", {}, -2),
    ],
)
def test_value_with_lists(text: str, given: dict[str, Any], expected: object) -> None:
    found = value(text, **given)
    assert type(found) is type(expected)
    assert same(found, expected)


@pytest.mark.parametrize(
    ("text", "given"),
    [
        ("u + u", {"u": 1 << 63}),
        ("u - u * 2", {"u": LARGEST + 2}),
        ("i * i", {"i": 1 << 32}),
        ("i * u", {"i": -2, "u": 1 << 63}),
        ("i ** 8", {"i": 1000}),
        ("-i", {"i": LOWEST}),
        ("i - 1", {"i": LOWEST}),
        ("i // -1", {"i": LOWEST}),
        ("i % (u - 5)", {}),
        ("x / f", {"f": 0.0}),
        ("x // f", {"f": -0.0}),
        ("x % f", {"f": 0.0}),
        ("round(x)", {"x": 9.3e18}),
        ("floor(f * x)", {"x": 1e300}),
        ("wrap(i, u, 3)", {}),
        ("i if flag else u", {"u": UNSIGNED, "flag": False}),
        ("many + large", {"large": [1]}),
        ("floats + other", {"floats": []}),
        ("(many / large)[0]", {"large": [1, 0]}),
        ("many[2]", {}),
        ("(many * 2)[0]", {"many": []}),
        ("[1 // u, 2][1]", {"u": 0}),
        ("2 in many // large", {"large": [0, 1]}),
        ("len(floats + other)", {"floats": []}),
        ("min(many)", {"many": []}),
        ("max(floats)", {"floats": []}),
        ("sum(large)", {"large": [UNSIGNED, 1]}),
        ("sum(signed)", {"signed": [LARGEST, 1, -1]}),
        ("x ** 8", {"x": 1e100}),
        ("sqrt(x)", {"x": -1.0}),
        ("sin(x)", {"x": math.inf}),
    ],
)
def test_what_has_no_value_is_a_mapping_error(text: str, given: dict[str, Any]) -> None:
    with pytest.raises(FAILURES) as caught:
        value(text, **given)
    assert not isinstance(caught.value, NonFiniteError)


@pytest.mark.parametrize("text", ["round(x)", "floor(x)", "ceil(x)", "trunc(-x)", "round(floats * x)[0]",
                                  "time_from_seconds(x)"])  # fmt: skip
@pytest.mark.parametrize("x", [math.nan, math.inf])
def test_no_integer_is_made_of_what_is_not_finite(text: str, x: float) -> None:
    with pytest.raises(NonFiniteError):
        value(text, x=x)


def filled(declared: Type, text: str, **given: Any) -> Any:
    """What a field of this type gets."""
    target = MessageType("made/msg/Target", (Field("filled", declared),))
    make = serializer(field_map(filled=text), target, scope_of(SOURCE, [MODE]))
    return deserialize(target, make(SimpleNamespace(**{**GIVEN, **given}))).filled


@pytest.mark.parametrize(
    ("declared", "text", "expected"),
    [
        (List(Float(32)), "many / 100", [1.5, 2.75]),
        (List(Float(64)), "floats + other * 2", [20.5, 38.5]),
        (List(Int(8, signed=True), length=2), "round(floats * 10)", [5, -15]),
        (List(String()), "names + '_' + text(floats, 1)", ["a_0.5", "b_-1.5"]),
        (List(Int(16, signed=False), bound=2), "wrap(many, 0, 255)", [150, 19]),
        (List(Int(16, signed=False)), "clamp(many)", [150, 275]),
        (Int(8, signed=True), "round(clamp(x * 100, -100, 100))", 100),
        (Int(8, signed=True), "round(x * 10) + 1", 26),
        (List(Float(64)), "floats if flag else other", [0.5, -1.5]),
    ],
)
def test_field_is_filled(declared: Type, text: str, expected: object) -> None:
    assert [*_plain(filled(declared, text))] == [*_plain(expected)]


def _plain(found: Any) -> list[Any]:
    return list(found) if not isinstance(found, (int, float, str)) else [found]


@pytest.mark.parametrize(
    ("declared", "text", "given"),
    [
        (List(Float(64), bound=1), "floats * 2", {}),
        (List(Float(64), length=3), "floats + other", {}),
        (List(Float(64)), "floats + other", {"other": []}),
        (Int(8, signed=True), "round(x)", {"x": 128.0}),
        (Int(8, signed=True), "round(x) + 1", {"x": 127.0}),
        (List(Int(8, signed=True)), "round(floats)", {"floats": [1.0, -129.0]}),
        (Float(32), "float32(x)", {"x": 1e300}),
        (List(Float(32)), "float32(floats * 1e39)", {}),
    ],
)
def test_what_does_not_fit_is_refused(declared: Type, text: str, given: dict[str, Any]) -> None:
    with pytest.raises(FAILURES):
        filled(declared, text, **given)

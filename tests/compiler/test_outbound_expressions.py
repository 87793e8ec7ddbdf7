"""Expressions over serialized ROS messages, and over names beside the message's fields."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from typing import Any

import pytest

from router.compiler.cdr import CdrReads
from router.compiler.expressions import ExpressionError, Scope, Typed, check
from router.compiler.expressions.kinds import MessageKind, TimeKind, kind_of
from router.compiler.namespace import NAMESPACE
from router.compiler.source import Source, load
from router.types.model import Bool, Field, Float, Int, List, MessageType, String
from tests.compiler.compiling import SPAN, written
from tests.compiler.reading import TIMES
from tests.oracles.reference import Value
from tests.oracles.reference_cdr import cdr

_UINT8 = Int(8, signed=False)
_, TIME = TIMES
BOX = MessageType("made/msg/Box", (Field("from", String()), Field("area", Float(64)), Field("seen", TIME)))
DECLARED = MessageType(
    "made/msg/Scene",
    (
        Field("left", BOX),
        Field("use_left", Bool()),
        Field("right", BOX),
        Field("boxes", List(BOX)),
        Field("item", _UINT8),
        Field("names", List(String())),
        Field("stamp", TIME),
    ),
)


def box(name: str, area: float, seconds: int) -> dict[str, Value]:
    return {"from": name, "area": area, "seen": {"sec": seconds, "nanosec": 5}}


SCENE: dict[str, Value] = {
    "left": box("left", 1.0, 1), "use_left": True, "right": box("right", 2.0, 2),
    "boxes": [box("first", 3.0, 3), box("second", 4.0, -4)], "item": 9, "names": ["a", "b"],
    "stamp": {"sec": 7, "nanosec": 8},
}  # fmt: skip


def scope_over(declared: MessageType, names: Mapping[str, Typed]) -> Scope:
    return Scope(declared, (), (), CdrReads(declared), names)


def evaluated(text: str, **given: Any) -> Any:
    """What an expression comes to; `given` are elements of `boxes` by the names that they have beside the fields."""
    names = {name: Typed.at(SPAN, kind_of(BOX), load(name)) for name in given}
    scope, out = scope_over(DECLARED, names), Source()
    typed = check(written(text), scope)
    with out.block(f"def evaluate(cdr, {', '.join(given)}):", SPAN):
        scope.reads.write(out, SPAN)
        out.line(f"return {out.expression(typed.node)}", SPAN)
    namespace: dict[str, Any] = {**NAMESPACE, **out.constants}
    exec(out.compile("table.yaml"), namespace)  # noqa: S102 - what is tested
    return namespace["evaluate"](cdr(DECLARED, SCENE), **given)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("left.area + right.area", 3.0),
        ("stamp", 7_000_000_008),
        ("left.seen", 1_000_000_005),
        ("message.item", 9),
        ("names[1]", "b"),
        ("len(boxes)", 2),
        ("boxes[1].area", 4.0),
        ("boxes[1].seen", -3_999_999_995),
        ("(left if use_left else right).area", 1.0),
        ("(right if use_left else left).seen", 2_000_000_005),
        ("[left, right][1].area", 2.0),
        ("(message if use_left else message).right.area", 2.0),
    ],
)
def test_expression_over_a_serialized_message(text: str, value: object) -> None:
    assert evaluated(text) == value


def test_name_beside_the_fields_wins_over_a_field() -> None:
    (first, _) = evaluated("boxes")
    assert evaluated("item.area", item=first) == 3.0
    assert evaluated("item.seen", item=first) == 3_000_000_005
    assert evaluated("message.item", item=first) == 9


def test_element_has_fields_that_are_called_as_keywords_are() -> None:
    (first, _) = evaluated("boxes")
    item = Typed.at(SPAN, kind_of(BOX), load("item"))
    name = scope_over(DECLARED, {"item": item}).field_of(item, BOX.fields[0], SPAN)
    code = compile(ast.Expression(name.node), "table.yaml", "eval")
    assert eval(code, {"item": first}) == "first"  # noqa: S307 - what is tested


def test_misspelt_name_beside_the_fields_is_suggested() -> None:
    scope = scope_over(DECLARED, {"total_count": Typed.at(SPAN, kind_of(_UINT8), load("total_count"))})
    with pytest.raises(ExpressionError) as raised:
        check(written("total_cuont"), scope)
    assert "total_count" in raised.value.diagnostic.hint


@pytest.mark.parametrize("text", ["has(left)", "has(item)", "has(item.area)", "has(left.area)"])
def test_has_finds_nothing_that_could_be_missing(text: str) -> None:
    scope = scope_over(DECLARED, {"item": Typed.at(SPAN, MessageKind(BOX), load("item"))})
    with pytest.raises(ExpressionError):
        check(written(text), scope)


def test_time_is_a_value() -> None:
    assert check(written("left.seen"), scope_over(DECLARED, {})).kind == TimeKind()

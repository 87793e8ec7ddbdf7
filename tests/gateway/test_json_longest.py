"""No sensible text of a message is longer than its type says, and types without bounds say so."""

from __future__ import annotations

import json
import math
import sys
from math import inf
from typing import Any

import pytest

from router.gateway.json_longest import longest_text
from router.gateway.style import Style
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.ros import ros_interfaces
from tests.gateway.client_json import tree

INSIDE = MessageType("made/msg/Inside", (Field("x", Float(64)), Field("y", String(bound=5))))
BOUNDED = MessageType(
    "made/msg/Bounded",
    (
        Field("a", Int(64, signed=True)),
        Field("b", Bool()),
        Field("c", List(INSIDE, length=3)),
        Field("d", List(Float(64), bound=4)),
        Field("e", String(bound=9, wide=True)),
        Field("f", MessageType("made/msg/Nothing", ())),
    ),
)
LONGEST: Any = {
    "a": -(2**63),
    "b": False,
    "c": [{"x": -sys.float_info.min, "y": "\x01" * 5}] * 3,
    "d": [-sys.float_info.max] * 4,
    "e": "\x01" * 9,
    "f": {"structure_needs_at_least_one_member": 255},
}


@pytest.mark.parametrize("style", Style)
def test_the_longest_values_pretty_printed_and_in_full_are_not_too_long(style: Style) -> None:
    text = json.dumps(tree(BOUNDED, LONGEST, is_wrapped=style is Style.WRAPPED), indent=8)
    in_full = text.replace(repr(-sys.float_info.max), f"{-sys.float_info.max:f}")
    assert len(in_full) > 1500
    assert len(in_full) < longest_text(BOUNDED, style) < 20_000


@pytest.mark.parametrize("style", Style)
@pytest.mark.parametrize(
    "declared",
    [String(), String(wide=True), List(Int(8, signed=True)), List(String(), length=2), List(List(Bool()), bound=2)],
    ids=str,
)
def test_what_has_no_bound_anywhere_has_none(declared: Type, style: Style) -> None:
    assert longest_text(declared, style) == inf
    assert longest_text(MessageType("made/msg/Open", (*BOUNDED.fields, Field("g", declared))), style) == inf


@pytest.mark.parametrize(
    ("name", "most"),
    [("std_msgs/msg/Int32", 2e3), ("geometry_msgs/msg/Twist", 1e4), ("geometry_msgs/msg/PoseWithCovariance", 5e4)],
)
def test_commands_are_short(name: str, most: float) -> None:
    declared = ros_interfaces().get(name)
    assert declared is not None
    assert 0 < longest_text(declared, Style.WRAPPED) < most


def test_a_list_of_no_elements_has_a_bound() -> None:
    assert math.isfinite(longest_text(List(String(), bound=0), Style.PLAIN))

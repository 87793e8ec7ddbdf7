"""The map form: what it chooses, and the maps that are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from router.compiler import check_table
from router.compiler.expressions import ExpressionError
from router.compiler.mapping import build
from router.errors import Code
from router.table.model.expressions import Expression, FieldMap
from router.types.model import Bool, Enum, Field, Float, Int, MessageType, String
from tests.compiler.compiling import SPAN, chosen, compiled, field_map, scope_of, serializer, written
from tests.compiler.machine import FAILURES
from tests.tables import ROUTES

GEAR = Enum("Gear", (("PARK", 0), ("DRIVE", 1), ("REVERSE", -1), ("GO", 1)))
SOURCE = MessageType(
    "Source",
    (Field("gear", GEAR), Field("ready", Bool()), Field("name", String()), Field("level", Int(32, True)),
     Field("speed", Float(32))),
    {"LOW": 5},
)  # fmt: skip
TARGET = MessageType("made/msg/Target", (Field("word", String()), Field("level", Int(8, True))))


def value(expression: Expression, **fields: Any) -> Any:
    _, evaluate = compiled(expression, scope_of(SOURCE, [GEAR]))
    defaults = {"gear": 0, "ready": False, "name": "", "level": 0, "speed": 0.0}
    return evaluate(SimpleNamespace(**defaults | fields))


def test_an_enum_chooses_by_the_names_of_its_values() -> None:
    chooser = chosen("gear", {"PARK": "10", "DRIVE": "level + 1", "REVERSE": "-1"})
    assert [value(chooser, gear=gear, level=5) for gear in (0, 1, -1)] == [10, 6, -1]


@pytest.mark.parametrize("gear", [7, -2, 2**31 - 1, -(2**31)])
def test_a_number_without_a_name_is_refused_without_else_and_takes_it_with_one(gear: int) -> None:
    named = {"PARK": "1", "DRIVE": "2", "REVERSE": "3"}
    assert value(chosen("gear", named, "4"), gear=gear) == 4
    with pytest.raises(FAILURES):
        value(chosen("gear", named), gear=gear)


def test_two_names_of_a_number_are_one_value() -> None:
    assert value(chosen("gear", {"GO": "2", "PARK": "0", "REVERSE": "1"}), gear=1) == 2


@pytest.mark.parametrize(
    ("chooser", "fields", "expected"),
    [
        (chosen("ready", {"true": "'on'", "false": "'off'"}), {"ready": True}, "on"),
        (chosen("ready", {"true": "'on'", "false": "'off'"}), {"ready": False}, "off"),
        (chosen("ready", {"False": "'off'", "True": "'on'"}), {"ready": True}, "on"),
        (chosen("ready", {"true": "1"}, "0"), {"ready": False}, 0),
        (chosen("name", {"imu": "1", "a b": "2"}, "3"), {"name": "a b"}, 2),
        (chosen("name", {"imu": "1"}, "3"), {"name": "gps"}, 3),
        (chosen("level", {"-3": "1", "0": "2", "LOW": "3"}, "4"), {"level": -3}, 1),
        (chosen("level", {"-3": "1", "0": "2", "LOW": "3"}, "4"), {"level": 5}, 3),
        (chosen("level + 1", {"1": "speed"}, "2"), {"level": 0, "speed": 0.5}, 0.5),
    ],
)
def test_other_subjects_choose_by_constants(chooser: Expression, fields: dict[str, Any], expected: object) -> None:
    assert value(chooser, **fields) == expected


@pytest.mark.parametrize(
    ("chooser", "code", "said"),
    [
        (chosen("gear", {"DRIVE": "1", "GO": "2"}, "0"), Code.DUPLICATE_KEY, "'GO' is the same value as 'DRIVE'"),
        (chosen("level", {"0x2": "1", "2": "2"}, "0"), Code.DUPLICATE_KEY, "'2' is the same value as '0x2'"),
        (chosen("gear", {"PRAK": "1"}, "2"), Code.UNKNOWN_ENUM_VALUE, "did you mean 'PARK'"),
        (chosen("gear", {"PARK": "1", "GO": "2"}), Code.MISSING_ENUM_VALUE, "REVERSE"),
        (chosen("ready", {"true": "1"}), Code.MISSING_ENUM_VALUE, "does not cover all values"),
        (chosen("level", {"1": "1"}), Code.MISSING_ENUM_VALUE, "does not cover all values"),
        (chosen("name", {"imu": "1"}), Code.MISSING_ENUM_VALUE, "does not cover all values"),
        (chosen("level", {"speed": "1"}, "2"), Code.TYPE_MISMATCH, "not a constant"),
        (chosen("level", {"'a'": "1"}, "2"), Code.TYPE_MISMATCH, "string"),
        (chosen("gear", {"PARK": "1", "DRIVE": "'a'"}, "2"), Code.TYPE_MISMATCH, "string"),
        (chosen("sped", {"1": "1"}, "2"), Code.UNKNOWN_FIELD, "sped"),
        (chosen("gear", {"PARK": "sped"}, "2"), Code.UNKNOWN_FIELD, "sped"),
        (chosen("level", {str(number): "1" for number in range(101)}, "2"), Code.EXPRESSION_SYNTAX, "100"),
    ],
)
def test_wrong_maps_are_findings(chooser: Expression, code: Code, said: str) -> None:
    with pytest.raises(ExpressionError) as refused:
        compiled(chooser, scope_of(SOURCE, [GEAR]))
    assert refused.value.diagnostic.code is code
    assert said in f"{refused.value.diagnostic.message} {refused.value.diagnostic.hint}"


TABLE = """
extends: {rover}
routes:
  imu_info:
    topics:
      - topic: mode
        type: std_msgs/msg/Header
        fields:
          frame_id: {{map: state, SENSOR_ERROR: {{text: not a field}}, SENSOR_IDLE: "'idle'", else: {{text: "4"}}}}
          stamp.sec: {{map: is_calibrated, true: 1, false: 0}}
      - {{topic: names, type: sensor_msgs/msg/JointState, fields: {{name: [source, {{text: source}}]}}}}
      - {{topic: number, type: std_msgs/msg/Int8, fields: {{data: {{map: source, sensor_board: 1}}}}}}
      - topic: word
        type: std_msgs/msg/String
        fields: {{data: {{map: str(state), text: {{text: map}}, else: source}}}}
"""


def test_maps_and_texts_of_a_table_become_expressions(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(rover=ROUTES / "rover.yaml"))
    checked = check_table(path)
    assert not checked.diagnostics
    [route] = [each for each in checked.routes if each.case.name == "imu_info"]
    rows = {row.target: row.expression for target in route.targets for row in target.rows}
    assert rows["frame_id"] == "{map: state, SENSOR_ERROR: 'not a field', SENSOR_IDLE: 'idle', else: '4'}"
    assert rows["stamp.sec"] == "{map: is_calibrated, true: 1, false: 0}"
    assert rows["name"] == "[source, 'source']"
    assert rows["data"] == "{map: str(state), text: 'map', else: source}"


def test_the_longest_map_is_compiled() -> None:
    chooser = chosen("level", {str(number): str(-number) for number in range(100)}, "7")
    assert [value(chooser, level=level) for level in (0, 99, 100)] == [0, -99, 7]


def test_what_a_map_chooses_has_to_fit_its_target() -> None:
    scope = scope_of(SOURCE, [GEAR])
    mapping = build(field_map(level=chosen("gear", {"PARK": "1"}, "1000")), TARGET, scope, SPAN)
    assert [finding.code for finding in mapping.findings] == [Code.OUT_OF_RANGE]


def text(word: str, field: str = "word") -> FieldMap:
    return field_map(**{field: replace(written(word), literal=True)})


@pytest.mark.parametrize("word", ["imu_link", "level", "'quoted'", "two words", "1 + 1", ""])
def test_text_stands_for_itself(word: str) -> None:
    compose = serializer(text(word), TARGET, scope_of(SOURCE))
    assert word.encode() + b"\0" in compose(SimpleNamespace(level=3))


def test_a_bare_word_is_an_error_that_says_both_readings() -> None:
    [finding] = build(field_map(word="nam"), TARGET, scope_of(SOURCE), SPAN).findings
    assert finding.code is Code.UNKNOWN_FIELD
    assert "did you mean 'name'?" in finding.hint
    assert "{text: nam}" in finding.hint


def test_text_is_for_strings_alone() -> None:
    [finding] = build(text("imu_link", "level"), TARGET, scope_of(SOURCE), SPAN).findings
    assert finding.code is Code.TYPE_MISMATCH


def test_a_message_with_a_field_called_text_is_filled_by_an_expression() -> None:
    note = MessageType("made/msg/Note", (Field("text", String()),))
    holder = MessageType("made/msg/Holder", (Field("note", note),))
    mapping = build(text("name", "note"), holder, scope_of(SOURCE), SPAN)
    assert [(row.target, row.expression) for row in mapping.rows] == [("note.text", "name")]

"""The functions that are made of a schema and jsonschema agree on which data fits it."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from router.rehearsal.reading import SCHEMA as TESTS
from router.table.compose import compose
from router.table.fast_schema import fitting
from router.table.nodes import to_data
from router.table.schema import SCHEMA, _fits, _validator, validator
from router.table.source import read_source
from tests.tables import ROUTES

VALUES: list[Any] = [
    None, True, False, -1, 0, 1, 2, 0.5, 1.0, 2.0, float("nan"), float("inf"), "", "a", "b", "ab", "ba", "a\n",
    [], [1], [2, "a"], ["a", "b"], ["a", "a"], [1, 1.0], [[], []], [{"a": 1}, {"a": 1}], [{"a": 1}, {"a": 2}],
    {}, {"a": 1}, {"a": "b"}, {"b": 1}, {"a": 2, "b": "a"}, {"ab": None}, {"a": {"a": "b"}},
]  # fmt: skip
DEFINITIONS = {
    "text": {"type": "string", "minLength": 2},
    "tree": {"additionalProperties": {"if": {"type": "object"}, "then": {"$ref": "#/definitions/tree"}}},
}
PARTS = [True, False, {"type": "string"}, {"const": 1}, {"$ref": "#/definitions/text"}]
LIMITS: dict[str, list[Any]] = {
    "type": ["object", "array", "string", "boolean", "null", "number", "integer", ["integer", "string"]],
    "enum": [[1], ["a", None, 0.5], [True, "b"]],
    "const": [0, False, 1.0],
    "pattern": ["a", "^a$"],
    **{key: [1, 0.5] for key in ("minimum", "maximum", "exclusiveMinimum")},
    **{key: [1, 2] for key in ("minLength", "minProperties", "maxProperties", "minItems")},
    "properties": [{"a": part} for part in PARTS],
    "required": [["a"], ["a", "b"]],
    **dict.fromkeys(("additionalProperties", "propertyNames", "items", "contains", "not"), PARTS),
    "uniqueItems": [True, False],
    **{key: [PARTS[2:3], PARTS[3:]] for key in ("allOf", "anyOf")},
    "if": PARTS,
    "then": PARTS,
    "else": PARTS,
    "$ref": ["#/definitions/text", "#/definitions/tree"],
    "title": ["words"],
}


def schemas() -> Iterator[dict[str, Any]]:
    """Each keyword with any other one, with each of their limits; and conditions with all that belongs to them."""
    for one, two in combinations(LIMITS, 2):
        yield from ({one: of_one, two: of_two} for of_one in LIMITS[one] for of_two in LIMITS[two])
    for condition in LIMITS["type"]:
        yield from ({"if": {"type": condition}, "then": then, "else": other} for then in PARTS for other in PARTS)


def test_they_agree() -> None:
    counted = [0, 0]
    for schema in schemas():
        schema["definitions"] = DEFINITIONS
        fits, known = fitting(schema), validator(schema)
        for value in VALUES:
            expected = known.is_valid(value)
            assert fits(value) == expected, (schema, value)
            counted[expected] += 1
    assert min(counted) > 10_000


def test_true_and_1_are_left_to_jsonschema_as_unique_items() -> None:
    schema = {"definitions": {}, "uniqueItems": True}
    assert (fitting(schema)([1, True]), validator(schema).is_valid([1, True])) == (False, True)


def test_a_keyword_that_they_do_not_know_is_no_schema() -> None:
    with pytest.raises(NotImplementedError, match="the schema uses multipleOf"):
        fitting({"definitions": {}, "multipleOf": 2})


# ---- our schemas

FILES = [*ROUTES.glob("*.yaml"), *(Path(__file__).parents[1] / "rehearsal" / "tables").glob("*.yaml")]
DATA: list[Any] = [to_data(compose(read_source(path), {}, [])) for path in sorted(FILES)]
WHOLE = {SCHEMA: [each for each in DATA if "tests" not in each], TESTS: [each for each in DATA if "tests" in each]}


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Each mapping and list of the data, with each of its keys or indexes."""
    for step in list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ():
        yield data, step
        yield from _places(data[step])


@pytest.mark.parametrize("name", WHOLE)
@given(data=st.data())
def test_they_agree_about_tables(name: str, data: st.DataObject) -> None:
    table = copy.deepcopy(data.draw(st.sampled_from(WHOLE[name])))
    parts = [holder[step] for whole in WHOLE[name] for holder, step in _places(whole)]
    for _ in range(data.draw(st.integers(0, 2))):
        holder, step = data.draw(st.sampled_from([*_places(table)]))
        holder[step] = copy.deepcopy(data.draw(st.sampled_from(VALUES + parts)))
        if data.draw(st.booleans()) and len(table) > 1:
            del holder[step]
    fits = _fits(name)(table)
    event(f"fits: {fits}")
    assert fits == _validator(name).is_valid(table)

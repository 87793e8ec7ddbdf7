"""The language of docs/reference/table.md: its examples, the oracle that was written from it, and the ranges that the
compiler knows.
"""

from __future__ import annotations

import ast
import math
import random
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st

from router.compiler.expressions import ExpressionError
from router.compiler.expressions.kinds import BoolKind, EnumKind, FloatKind, IntKind, Kind, StringKind
from router.types.model import Bool, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.carrier.answering import carrier_plane
from tests.compiler.comparing import same
from tests.compiler.compiling import compiled, context_of, outcome, scope_of, written
from tests.compiler.judging import (
    Answer,
    Misfit,
    Question,
    disagreement,
    messages,
    question,
)
from tests.compiler.language import Language, language_wire, some_language
from tests.compiler.machine import FAILURES, functions
from tests.oracles.reference_expressions import Context, evaluate
from tests.oracles.reference_kinds import MAPPING_ERROR, NON_FINITE, Refused

MANY = settings(max_examples=10 * settings().max_examples, suppress_health_check=list(HealthCheck))
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "table.md"


# ---- the page and the oracle


def rows(heading: str, columns: int) -> list[list[str]]:
    """The rows of the tables in a section of the page."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n### {heading}\n")[1].split("\n### ")[0]
    lines = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line] for line in lines if len(line) == columns and "---" not in line[0]]


def context(**values: Any) -> Context:
    """Values by name; with the type in front where it is not said by the value."""
    typed = {name: value if isinstance(value, tuple) else (type_of(value), value) for name, value in values.items()}
    declared = MessageType("Source", tuple(Field(name, type_) for name, (type_, _) in typed.items()))
    return context_of({name: value for name, (_, value) in typed.items()}, declared, [MODE])


def type_of(value: Any) -> Type:
    match value:
        case bool():
            return Bool()
        case int():
            return Int(64, signed=True)
        case float():
            return Float(64)
        case list():
            return List(type_of(value[0]) if value else Float(64))
        case _:
            return String()


MODE = Enum("Mode", (("OFF", 0), ("ON", 1)))
U8, I16, I64, U64, F64 = Int(8, False), Int(16, True), Int(64, True), Int(64, False), Float(64)


@pytest.mark.parametrize(("expression", "operands", "result"), rows("Lists", 3)[1:])
def test_the_page_shows_what_lists_come_to(expression: str, operands: str, result: str) -> None:
    text, made = expression.strip("`"), result.strip("`")
    if operands == "scalars":
        values = {"x": 1.5, "y": -2.0}
        assert evaluate(written(text), context(**values)) == evaluate(written(made), context(**values))
        return
    names = list(dict.fromkeys(re.findall(r"[a-z_]\w*", re.sub(r"'\w*'|\w+\(", "", text))))
    values = dict(zip(names, map(ast.literal_eval, re.findall(r"\[.*?\]", operands)), strict=True))
    assert evaluate(written(text), context(**values)) == ast.literal_eval(made)


def test_the_page_tells_the_ranges_of_integers() -> None:
    shown = {row[0].strip("`"): row[1] for row in rows("Numbers", 3) if "`" in row[0]}
    assert shown["a * b` of two `int16"] == "-2^30+2^15 to 2^30"
    most = context(a=(I16, -(1 << 15)), b=(I16, (1 << 15) - 1))
    assert evaluate(written("a * a"), most) == 1 << 30
    assert evaluate(written("a * b"), most) == -(1 << 30) + (1 << 15)


LEAST, MOST, GREATEST = -(1 << 63), (1 << 63) - 1, (1 << 64) - 1


@pytest.mark.parametrize(
    ("text", "values", "result"),
    [
        ("a + 1", {"a": MOST}, MAPPING_ERROR),
        ("a - 1", {"a": LEAST}, MAPPING_ERROR),
        ("-a", {"a": LEAST}, MAPPING_ERROR),
        ("abs(a)", {"a": LEAST}, 1 << 63),
        ("a // -1", {"a": LEAST}, MAPPING_ERROR),
        ("a % -1", {"a": LEAST}, 0),
        ("a // 2", {"a": -3}, -2),
        ("a % 3", {"a": -1}, 2),
        ("a % -3", {"a": 1}, -2),
        ("a + b", {"a": (U64, GREATEST), "b": (U64, 1)}, MAPPING_ERROR),
        ("a + b", {"a": (U64, GREATEST), "b": (U64, 0)}, GREATEST),
        ("a - b", {"a": (U64, GREATEST), "b": (U64, 0)}, MAPPING_ERROR),
        ("a - b", {"a": (U64, 0), "b": (U64, 1 << 63)}, LEAST),
        ("a + b", {"a": (U64, GREATEST), "b": (U8, 0)}, GREATEST),
        ("a + b", {"a": (U64, GREATEST), "b": (I16, -1)}, MAPPING_ERROR),
        ("a + b", {"a": (U64, 5), "b": (I16, -9)}, -4),
        ("a if c else b", {"a": (U64, GREATEST), "b": 1, "c": True}, MAPPING_ERROR),
        ("a if c else b", {"a": (U64, MOST), "b": 1, "c": True}, MOST),
        ("max(a, b)", {"a": (U64, GREATEST), "b": 1}, GREATEST),
        ("min(a, b)", {"a": (U64, GREATEST), "b": -1}, -1),
        ("a ** 8", {"a": (I16, 200)}, 200**8),
        ("a ** 8", {"a": (I16, 300)}, MAPPING_ERROR),
        ("a ** 3", {"a": (U64, 2642245)}, 2642245**3),
        ("a ** 3", {"a": (U64, 2642246)}, MAPPING_ERROR),
        ("a / b", {"a": (1 << 53) + 1, "b": 1}, float(1 << 53)),
        ("a == b", {"a": (1 << 53) + 1, "b": float(1 << 53)}, False),
        ("a < b", {"a": (U64, GREATEST), "b": 2.0**64}, True),
        ("a < b", {"a": -1, "b": (U64, GREATEST)}, True),
        ("a in [b]", {"a": (1 << 53) + 1, "b": float(1 << 53)}, False),
        ("max(a, 0.5)", {"a": (1 << 53) + 1}, float(1 << 53)),
        ("1 / a", {"a": 0}, MAPPING_ERROR),
        ("1 // a", {"a": 0.0}, MAPPING_ERROR),
        ("1 % a", {"a": -0.0}, MAPPING_ERROR),
        ("a * a", {"a": 1e300}, math.inf),
        ("a ** 2", {"a": 1e300}, MAPPING_ERROR),
        ("a ** 2", {"a": math.inf}, math.inf),
        ("hypot(a, a)", {"a": 1.7e308}, math.inf),
        ("sqrt(a)", {"a": -1.0}, MAPPING_ERROR),
        ("sin(a)", {"a": math.inf}, MAPPING_ERROR),
        ("sin(a)", {"a": math.nan}, math.nan),
        ("float32(a)", {"a": 1e39}, MAPPING_ERROR),
        ("float32(a)", {"a": math.inf}, math.inf),
        ("round(a)", {"a": math.nan}, NON_FINITE),
        ("round(a)", {"a": -math.inf}, NON_FINITE),
        ("round(a)", {"a": 2.0**63}, MAPPING_ERROR),
        ("round(a)", {"a": -(2.0**63)}, LEAST),
        ("round(a)", {"a": 2.5}, 2),
        ("trunc(a)", {"a": -2.5}, -2),
        ("round(a) + b", {"a": 1.0, "b": (U64, GREATEST - 1)}, MAPPING_ERROR),
        ("round(clamp(a, 0, 100)) + b", {"a": 1.0, "b": (U64, GREATEST - 1)}, GREATEST),
        ("clamp(a, -1, 1)", {"a": math.nan}, math.nan),
        ("min(a, 1)", {"a": math.nan}, math.nan),
        ("min(1, a)", {"a": math.nan}, 1.0),
        ("max(a, 0)", {"a": -0.0}, -0.0),
        ("wrap(a, b, 0)", {"a": 5, "b": 1}, MAPPING_ERROR),
        ("wrap(190, -180, 179)", {}, -170),
        ("str(a) + str(b) + str(c)", {"a": -7, "b": True, "c": (MODE, 5)}, "-7True5"),
        ("text(a, 2)", {"a": 2.675}, "2.67"),
        ("text(a, 1)", {"a": -0.04}, "-0.0"),
        ("text(a, 0)", {"a": 2.5}, "2"),
        ("text(a, 2)", {"a": -math.inf}, "-inf"),
        ("text(a, 2)", {"a": math.nan}, "nan"),
        ("text(a, 1)", {"a": (1 << 53) + 1}, "9007199254740992.0"),
        ("a + b", {"a": [1, 2], "b": [1]}, MAPPING_ERROR),
        ("a + 1 / b", {"a": [], "b": 0}, []),
        ("a + 1 // b", {"a": [1], "b": 0}, MAPPING_ERROR),
        ("len(1 // a)", {"a": [1, 0]}, MAPPING_ERROR),
        ("a[2]", {"a": [1, 2]}, MAPPING_ERROR),
        ("(1 / a)[0]", {"a": [1, 0]}, MAPPING_ERROR),
        ("[1 / a, 2][1]", {"a": 0}, MAPPING_ERROR),
        ("min(a)", {"a": []}, MAPPING_ERROR),
        ("sum(a)", {"a": []}, 0.0),
        ("sum(a)", {"a": [0.1, 0.2, 0.3, -0.6]}, 0.1 + 0.2 + 0.3 - 0.6),
        ("sum(a)", {"a": [MOST, 1, -5]}, MAPPING_ERROR),
        ("sum(a)", {"a": (List(U64), [GREATEST - 1, 1])}, GREATEST),
        ("max(a) - min(a)", {"a": [3, -4, 9]}, 13),
        ("len(a + 1)", {"a": [3, 4]}, 2),
        ("4 in a + 1", {"a": [3, 4]}, True),
        ("0.5 in 1 / a", {"a": [2, 0]}, MAPPING_ERROR),
        ("round(a)", {"a": [1.0, math.nan]}, NON_FINITE),
        ("b if a else [1, 2]", {"a": False, "b": [3]}, [1, 2]),
        ("a == 0 or 1 / a > 0", {"a": 0}, True),
        ("a > 0 < 1 / a", {"a": 0}, False),
        ("message.from + from + message.in", {"from": 1, "in": 5}, 7),
        ("a", {"a": b"\xff"}, MAPPING_ERROR),
    ],
)
def test_the_oracle_does_what_the_page_says(text: str, values: dict[str, Any], result: Any) -> None:
    if result in (MAPPING_ERROR, NON_FINITE):
        with pytest.raises(Refused) as refused:
            evaluate(written(text), context(**values))
        assert refused.value.reasons == {result}
        return
    found = evaluate(written(text), context(**values))
    assert same(found, result)
    assert math.copysign(1, found) == math.copysign(1, result) if found == 0 else True


def test_of_two_reasons_each_may_be_given() -> None:
    with pytest.raises(Refused) as refused:
        evaluate(written("round(a) + 1 // b"), context(a=math.nan, b=0))
    assert refused.value.reasons == {MAPPING_ERROR, NON_FINITE}


# ---- the compiler and the judge

noises = st.integers(0, (1 << 64) - 1).map(random.Random)
"""They do not shrink, but there can be many of them."""


@MANY
@given(noises)
def test_values_are_in_the_range_that_the_compiler_knows(noise: random.Random) -> None:
    language = Language(is_ros=False)
    text = language.text(noise, noise.choice("ifbs"), 3)
    try:
        node, run = compiled(text, scope_of(language.source, language_wire()[0].enums.values()))
    except ExpressionError:
        reject()
    for _, view in messages(noise, language):
        value = outcome(partial(run, view.message))
        if value is not FAILURES:
            assert_of_kind(value, node.kind)


def assert_of_kind(value: object, kind: Kind) -> None:
    match kind:
        case IntKind(low, high):
            assert isinstance(value, int)
            assert low <= value <= high
        case FloatKind(_, low, high):
            assert isinstance(value, (int, float))
            assert low <= value <= high or value != value  # noqa: PLR0124 - NaN
        case EnumKind():
            assert isinstance(value, int)
        case BoolKind():
            assert isinstance(value, bool)
        case StringKind():
            assert isinstance(value, str)
        case _:
            raise TypeError(kind)


def test_a_plane_that_is_wrong_by_one_bit_is_found() -> None:
    def wrong(asked: Question) -> Callable[[bytes], list[Answer]]:
        serve = carrier_plane(functions())(asked)

        def answers(message: bytes) -> list[Answer]:
            return [
                bytes([*made[:-1], made[-1] ^ 1]) if isinstance(made, bytes) and made else made
                for made in serve(message)
            ]

        return answers

    found = []
    for seed in range(40):
        noise = random.Random(seed)
        with suppress(Misfit):
            found.append(disagreement(question(noise, some_language(noise)), wrong, noise))
    assert len([each for each in found if each]) > len(found) / 2

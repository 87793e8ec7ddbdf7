from __future__ import annotations

import pytest

from router.errors import Code
from router.table.source import fill

ENVIRON = {"HOST": "10.0.0.1", "EMPTY": "", "NESTED": "${HOST}"}


@pytest.mark.parametrize(
    ("text", "filled"),
    [
        ("${HOST}:8", "10.0.0.1:8"),
        ("${HOST:-1.2.3.4}", "10.0.0.1"),
        ("${NOPE:-1.2.3.4}:8", "1.2.3.4:8"),
        ("${NOPE:-}", ""),
        ("${EMPTY}", ""),
        ("${EMPTY:-default}", "default"),
        ("${HOST}${HOST}", "10.0.0.110.0.0.1"),
        ("${NOPE:-a b:c}", "a b:c"),
        ("$HOST costs 5$", "$HOST costs 5$"),
    ],
)
def test_variables_are_filled_in(text: str, filled: str) -> None:
    assert fill(text, ENVIRON) == (filled, [])


@pytest.mark.parametrize(
    ("text", "bad", "code"),
    [
        ("a${NOPE}b", "${NOPE}", Code.UNDEFINED_VARIABLE),
        ("${HOST", "${HOST", Code.BAD_VALUE),
        ("${}x", "${}", Code.BAD_VALUE),
        ("${1A}", "${1A}", Code.BAD_VALUE),
        ("${HOST-x}", "${HOST-x}", Code.BAD_VALUE),
        ("${NOPE:-${HOST}}", "${NOPE:-${HOST}", Code.BAD_VALUE),
        ("${NESTED}", "${NESTED}", Code.BAD_VALUE),
    ],
)
def test_what_cannot_be_filled_in_is_blamed_itself(text: str, bad: str, code: Code) -> None:
    _, [problem] = fill(text, ENVIRON)
    assert text[problem.start : problem.end] == bad
    assert problem.code is code


def test_every_problem_is_reported() -> None:
    _, problems = fill("${A}${B}", {})
    assert [problem.start for problem in problems] == [0, 4]


def test_a_misspelt_variable_gets_a_suggestion() -> None:
    _, [problem] = fill("${BASESTATON}", {"BASESTATION": "x"})
    assert problem.hint.startswith("did you mean 'BASESTATION'?")

"""The schema of test files as an editor sees it, through the modeline of a test file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.table.language_server import REPOSITORY, LanguageServer, started

HEAD = "# yaml-language-server: $schema=../schemas/table-test.schema.json\n"


@pytest.fixture(scope="module")
def editor() -> Iterator[LanguageServer]:
    yield from started()


@pytest.mark.parametrize(
    ("test", "said"),
    [
        ("{expect: nothin}", "must be 'nothing', 'any', or a mapping of what happens"),
        ("{expect: {rejected: lost}}", "must be one of truncated, empty"),
        ("{given: {fro: sensor_board}, expect: any}", "Property fro is not allowed."),
        ("{given: {age: 3}, expect: any}", "must be a duration with its unit, such as '300ms'"),
        ("{given: {hex: '0'}, expect: any}", "must be bytes in hex in quotes"),
        ("{steps: [{at: 5s}]}", 'Missing property "expect".'),
    ],
)
def test_mistakes_are_underlined(editor: LanguageServer, test: str, said: str) -> None:
    path = REPOSITORY / "routes" / f"unsaved-{abs(hash(test))}.test.yaml"
    (found,) = editor.open(path, f"{HEAD}tests:\n  a: {test}\n")
    assert found["message"].startswith(said)
    assert found["range"]["start"]["line"] == 2

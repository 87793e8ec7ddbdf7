"""What tables do, said by table tests: each `tables/*.test.yaml` passes."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.compiler.lookup import Definitions
from router.rehearsal.reading import read_test_file
from router.rehearsal.running import run_tests

TABLES = Path(__file__).parent / "tables"
DEFINITIONS = Definitions()


@pytest.mark.parametrize("name", sorted(path.name for path in TABLES.glob("*.test.yaml")))
def test_a_table_does_what_its_tests_say(name: str) -> None:
    results = run_tests(read_test_file(TABLES / name, DEFINITIONS))
    assert results
    assert [f"{failure.span}: {failure.message}" for result in results for failure in result.failures] == []

"""A router of which only the counters exist."""

from __future__ import annotations

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from tests.observe.counting import TABLE, Counting
from tests.tables import ROUTES


@pytest.fixture(scope="session")
def counted(tmp_path_factory: pytest.TempPathFactory) -> CompiledTable:
    table = tmp_path_factory.mktemp("counted") / "table.yaml"
    table.write_text(TABLE.format(routes=ROUTES))
    checked = check_table(table)
    assert checked.program is not None, [*map(str, checked.diagnostics)]
    return checked.program


@pytest.fixture
def router(counted: CompiledTable) -> Counting:
    """A router whose health was evaluated once."""
    counting = Counting(counted)
    counting.look(0)
    return counting

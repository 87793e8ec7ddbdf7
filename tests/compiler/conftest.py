"""The rover's own tables, checked once."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.compiler import Checked, check_table
from router.compiler.definitions import Definitions
from router.compiler.program import Program

ROUTES = Path(__file__).parents[2] / "routes"


@pytest.fixture(scope="session")
def definitions() -> Definitions:
    return Definitions()


@pytest.fixture(scope="session")
def rover(definitions: Definitions) -> Checked:
    return check_table(ROUTES / "rover.yaml", {}, definitions)


@pytest.fixture(scope="session")
def rover_program(rover: Checked) -> Program:
    assert rover.diagnostics == []
    assert rover.program is not None
    return rover.program

"""Reloads without a pause under traffic: nothing is lost uncounted, and nothing is used after it was freed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.carrier.building import MEMORY, RACES, run_program


@pytest.mark.slow
@pytest.mark.parametrize("sanitizers", ["", MEMORY, RACES])
def test_a_storm_of_reloads_with_traffic(sanitizers: str, tmp_path: Path) -> None:
    run_program("storm", tmp_path, 1000, sanitizers=sanitizers)

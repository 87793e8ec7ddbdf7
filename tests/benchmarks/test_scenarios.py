"""The scenarios are consistent, and the tables that they run are good ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.versus import sized
from benchmarks.versus.contenders import TABLES, Ports
from benchmarks.versus.scenarios import SCENARIOS, Scenario
from router.compiler import check_table


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_what_a_figure_is_compared_with_is_measured(scenario: Scenario) -> None:
    names = [contender.name for contender in scenario.contenders]
    assert len(set(names)) == len(names)
    assert {aim.of for aim in scenario.aims} <= {*names}
    assert {aim.against for aim in scenario.aims} <= {*names, None}


@pytest.mark.parametrize("table", sorted(TABLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_each_table_is_good_with_ports_of_this_machine(table: Path) -> None:
    assert list(map(str, check_table(table, Ports.free().variables()).diagnostics)) == []


def test_a_table_that_is_made_is_good_but_for_the_lock_that_it_needs_none_of(tmp_path: Path) -> None:
    sized.write(sized.SMALL, tmp_path / "made")
    checked = check_table(tmp_path / "made" / "table.yaml")
    assert [str(finding.code.value) for finding in checked.diagnostics] == ["not-locked"]
    assert checked.program is not None
    assert len(checked.program.table.routes) == sized.SMALL.routes
    assert all(len(route.topics) == 2 and len(route.destinations) == 1 for route in checked.program.table.routes)

"""The scenarios are consistent, and the tables that they run are good ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.versus import sized
from benchmarks.versus.contenders import PAYLOADS, TABLES, Ports, datagrams
from benchmarks.versus.scenarios import SCENARIOS, Scenario
from benchmarks.versus.subscriber import number_of
from router.compiler import check_table


def test_names_are_unique() -> None:
    assert len({scenario.name for scenario in SCENARIOS}) == len(SCENARIOS)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_what_a_figure_is_compared_with_is_measured(scenario: Scenario) -> None:
    names = [contender.name for contender in scenario.contenders]
    assert len(set(names)) == len(names)
    assert {aim.against for aim in scenario.aims} <= {*names[1:], None}


@pytest.mark.parametrize("table", sorted(TABLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_each_table_is_good_with_ports_of_this_machine(table: Path) -> None:
    assert list(map(str, check_table(table, Ports.free().variables()).diagnostics)) == []


@pytest.mark.parametrize("count", [sized.SMALL, sized.LARGE])
def test_a_table_of_any_size_is_good_but_for_the_lock_that_it_needs_none_of(tmp_path: Path, count: int) -> None:
    sized.write(count, tmp_path / "made")
    checked = check_table(tmp_path / "made" / "table.yaml")
    assert [str(finding.code.value) for finding in checked.diagnostics] == ["not-locked"]
    assert checked.program is not None
    assert len(checked.program.table.routes) == count
    assert all(len(route.topics) == 2 and len(route.destinations) == 1 for route in checked.program.table.routes)


def test_its_datagrams_are_one_of_each_case_and_those_of_the_rover_unchanged(tmp_path: Path) -> None:
    sized.write(sized.LARGE, tmp_path / "made")
    made = dict(datagrams(tmp_path / "made" / "payloads.txt"))
    assert len(made) == sized.LARGE
    rovers = datagrams(PAYLOADS)[: len(sized.REAL)]
    assert all(made[case] == datagram for case, datagram in rovers)


@pytest.mark.parametrize(("sent", "expected"), [(0, 0), (1, 1), (2, 1), (3, 2), (4, 3), (9, 6)])
def test_a_subscriber_should_get_what_its_payload_cases_became(sent: int, expected: int) -> None:
    assert number_of({"imu_info"}, sent, ["imu_info", "gps_info", "imu_info"]) == expected

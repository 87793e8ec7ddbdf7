"""The file of results, and how it is shown."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

from benchmarks.versus import report, results
from benchmarks.versus.building import ROOT
from benchmarks.versus.figures import judge
from benchmarks.versus.scenarios import SCENARIOS

FIRST, SECOND = SCENARIOS[:2]


def entry(cpu_us: float, noise: float = 0) -> dict[str, Any]:
    """Of the first scenario, as if the peer took 10 us for a datagram."""
    rounds = {
        "router": [{"cpu_us@1000": cpu_us, "noise": noise}],
        "peer": [{"cpu_us@1000": 10.0}],
    }
    return results.entry(FIRST, rounds, judge(FIRST.aims, rounds), 4)


def test_a_scenario_takes_its_old_place_and_leaves_the_others_alone(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    known = results.load(path)
    results.merge(known, SECOND.name, entry(5))
    results.merge(known, FIRST.name, entry(5))
    results.store(path, known)
    again = results.load(path)
    results.merge(again, FIRST.name, entry(20))
    assert list(again["scenarios"]) == [FIRST.name, SECOND.name]
    assert again["scenarios"][SECOND.name] == known["scenarios"][SECOND.name]
    assert again["scenarios"][FIRST.name]["figures"][0]["verdict"] == "missed"


def test_the_file_names_neither_this_machine_nor_its_folders() -> None:
    text = json.dumps(results.empty() | {"scenarios": entry(5)})
    assert socket.gethostname() not in text
    assert str(ROOT) not in text


def test_a_figure_is_shown_with_ratio_aim_verdict_and_what_disturbed_it() -> None:
    [row] = report.cells(entry(5, noise=0.2))
    assert row == ("cpu_us@1000", "5", "peer 10", "0.50", "0.5 to 0.5", "<= 0.75", "met", "router noisy")


def test_the_page_has_a_table_for_each_scenario() -> None:
    page = report.page(results.empty() | {"scenarios": {FIRST.name: entry(5)}})
    assert f"## `{FIRST.name}`" in page
    assert "| cpu_us@1000 | 5 | peer 10 | 0.50 | 0.5 to 0.5 | <= 0.75 | met |" in page

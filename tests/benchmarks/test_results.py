"""The file of results."""

from __future__ import annotations

import json
import platform
import socket
from pathlib import Path
from typing import Any

from benchmarks.versus import results
from benchmarks.versus.building import ROOT
from benchmarks.versus.figures import judge
from benchmarks.versus.scenarios import SCENARIOS

FIRST, SECOND = SCENARIOS[:2]


def entry(cpu_us: float) -> dict[str, Any]:
    """Of the first scenario, as if the peer took 10 us for a datagram."""
    rounds = {
        "router": [{"cpu_us@1000": cpu_us}],
        "peer": [{"cpu_us@1000": 10.0}],
    }
    return results.entry(FIRST.title, rounds, judge(FIRST.aims, rounds), 4)


def test_a_scenario_takes_its_old_place_and_leaves_the_others_alone(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    known = results.load(path)
    results.merge(known, SECOND.name, entry(5))
    results.merge(known, FIRST.name, entry(5))
    results.store(path, known)
    again = results.load(path)
    results.merge(again, FIRST.name, entry(20))
    assert list(again["scenarios"]) == [SECOND.name, FIRST.name]
    assert again["scenarios"][SECOND.name] == known["scenarios"][SECOND.name]
    assert again["scenarios"][FIRST.name]["figures"][0]["verdict"] == "missed"


def test_the_file_names_neither_this_machine_nor_its_folders_nor_its_kernel() -> None:
    text = json.dumps(results.empty() | {"scenarios": entry(5)})
    assert socket.gethostname() not in text
    assert str(ROOT) not in text
    assert platform.release() not in text

"""The benchmark runs: really, but for much less time than figures would take. No figure is looked at."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.versus.building import ROOT, missing_packages

pytestmark = pytest.mark.slow

PATIENCE = 300
ONLY = ["own_table", "latency_thick", "outbound", "footprint", "idle", "flood"]
"""One of each way of measuring that is done soon."""


def test_an_unknown_scenario_is_refused_and_the_known_ones_are_named() -> None:
    words = [sys.executable, "-m", "benchmarks.versus", "--only", "own_tabel"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 2
    assert "own_table" in done.stderr


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="the benchmark needs two processor cores")
@pytest.mark.skipif(bool(missing_packages()), reason=f"missing to build the peer: {' '.join(missing_packages())}")
def test_it_measures_router_and_peer_and_writes_what_it_found(tmp_path: Path) -> None:
    output = tmp_path / "results.json"
    words = [sys.executable, "-m", "benchmarks.versus", "--quick", "--only", ",".join(ONLY), "--output", str(output)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(output.read_text())["scenarios"]
    assert list(found) == ONLY
    for scenario in found.values():
        assert scenario["figures"]
        assert all(figure["median"] > 0 for figure in scenario["figures"])
    assert all(name in done.stdout for name in ONLY)

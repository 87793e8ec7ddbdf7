"""Tests of the product use tables of their own, so that a team may edit `routes/` and `protos/`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", ["routes/rover.yaml", "protos/envelope.lock.json", "deploy/grafana/rover.json"])
def test_no_test_reads_what_a_team_edits(name: str) -> None:
    """Programs that tests start are not watched."""
    for path in (Path(name), ROOT / name):
        with pytest.raises(AssertionError, match="which is the team's"):
            path.read_bytes()


def test_the_tables_of_the_repository_have_no_errors() -> None:
    """Errors only: whether they do what they promise is for `make validate`."""
    command = [sys.executable, "-m", "router", "validate", "routes"]
    checked = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout + checked.stderr

"""Tests of the router use their own tables, so that a team may edit `routes/` and `protos/`."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", ["routes/rover.yaml", "protos/envelope.lock.json"])
def test_no_test_reads_what_a_team_edits(name: str) -> None:
    """Does not see the programs that tests start."""
    for path in (Path(name), ROOT / name):
        with pytest.raises(AssertionError, match="which is the team's"):
            path.read_bytes()

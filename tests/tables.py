"""The rover that tests are about: `tests/rover/`, with tables and protos of its own.

A team edits `routes/` and `protos/`; tests of the product read neither. tests/test_own_tables.py sees to that.
"""

from __future__ import annotations

import shutil
from pathlib import Path

RIG = Path(__file__).parent / "rover"
ROUTES = RIG / "routes"
PROTOS = RIG / "protos"


def ship(folder: Path) -> None:
    """Replaces the tables and protos in a package, which are those that a team edits, by those of the tests."""
    for ours in (ROUTES, PROTOS):
        shutil.rmtree(folder / ours.name)
        shutil.copytree(ours, folder / ours.name)

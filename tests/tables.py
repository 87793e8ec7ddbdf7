"""The rover that tests are about: `tests/rover/`, with tables and protos of its own.

A team edits `routes/` and `protos/`; tests of the product read neither. tests/test_own_tables.py sees to that.
"""

from __future__ import annotations

from pathlib import Path

RIG = Path(__file__).parent / "rover"
ROUTES = RIG / "routes"
PROTOS = RIG / "protos"

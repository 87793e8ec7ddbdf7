"""The rover's table without `record`, which no table that extends it can take away. Knows nothing of measuring."""

from __future__ import annotations

import re
import shutil

from benchmarks.versus.building import PROGRAMS
from benchmarks.versus.contenders import TABLES
from tests.tables import PROTOS, ROUTES

FOLDER = PROGRAMS / "unrecorded"
TABLE = FOLDER / "tables" / "rover.yaml"


def write() -> None:
    """Makes TABLE and all that it needs."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    shutil.copytree(PROTOS, FOLDER / PROTOS.name)
    shutil.copytree(ROUTES, FOLDER / ROUTES.name)
    rover = FOLDER / ROUTES.name / "rover.yaml"
    text = rover.read_text(encoding="utf-8")
    rover.write_text(re.sub(r"^record:.*\n(?: .*\n)+", "", text, flags=re.MULTILINE), encoding="utf-8")
    TABLE.parent.mkdir()
    for name in ("shipped.yaml", TABLE.name):
        text = (TABLES / name).read_text(encoding="utf-8").replace("../../tests/rover/", "../")
        (TABLE.parent / name).write_text(text, encoding="utf-8")

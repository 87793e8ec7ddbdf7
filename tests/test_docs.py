"""The generated reference pages are up to date, and the examples of the route table are good ones."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from router.compiler import check_table

DOCS = Path(__file__).parent.parent / "docs"
ROVER = DOCS.parent / "routes" / "rover.yaml"
EXAMPLES = re.findall(r"^```yaml\n(.*?)^```", (DOCS / "table.md").read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
PAGES = runpy.run_path(str(DOCS / "generate.py"))["PAGES"]


@pytest.mark.parametrize("name", PAGES)
def test_page_is_what_the_code_says(name: str) -> None:
    assert (DOCS / name).read_text(encoding="utf-8") == PAGES[name](), "run `python docs/generate.py`"


@pytest.mark.parametrize("example", EXAMPLES)
def test_each_example_of_a_table_is_good_in_place_of_what_the_rover_has(tmp_path: Path, example: str) -> None:
    table = tmp_path / "table.yaml"
    table.write_text(f"extends: {ROVER}\n{example}")
    assert list(map(str, check_table(table).diagnostics)) == []

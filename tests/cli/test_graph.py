"""`router graph` writes what the suffix says, and nothing of a table that is wrong."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from router.cli import OK, main
from tests.tables import ROUTES

ROVER = ROUTES / "rover.yaml"
needs_graphviz = pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")


@pytest.mark.parametrize(
    ("suffix", "beginning"),
    [
        pytest.param(".svg", "<svg ", marks=needs_graphviz),
        (".mmd", "---\ntitle: 'rover.yaml'\n---\n"),
        (".dot", 'digraph "rover.yaml" {\n'),
    ],
)
def test_the_suffix_chooses_what_is_written(
    tmp_path: Path, suffix: str, beginning: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / f"routes{suffix}"
    assert main(["graph", str(ROVER), "-o", str(output)]) == OK
    assert output.read_text(encoding="utf-8").startswith(beginning)
    assert re.fullmatch(rf"{output}: [0-9]+ routes\n", capsys.readouterr().err)

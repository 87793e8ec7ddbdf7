"""`router graph` writes what the suffix says, and nothing of a table that is wrong."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main
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


def test_without_graphviz_a_picture_is_refused_and_text_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["graph", str(ROVER), "-o", str(tmp_path / "x.svg")]) == BAD_USAGE
    assert "an .svg is drawn by Graphviz, which is not installed" in capsys.readouterr().err
    assert not (tmp_path / "x.svg").exists()
    assert main(["graph", str(ROVER), "-o", str(tmp_path / "x.dot")]) == OK


def test_another_suffix_is_refused_with_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["graph", str(ROVER), "-o", "routes.png"])
    assert ended.value.code == BAD_USAGE
    assert "'routes.png' does not end in .svg, .mmd, .dot" in capsys.readouterr().err


def test_a_wrong_table_is_not_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "table.yaml"
    table.write_text("version: 2\n")
    assert main(["graph", str(table), "-o", str(tmp_path / "x.svg")]) == BAD_TABLE
    assert "error[" in capsys.readouterr().err
    assert not (tmp_path / "x.svg").exists()


def test_a_file_that_cannot_be_written_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["graph", str(ROVER), "-o", str(tmp_path / "no" / "x.mmd")]) == BAD_USAGE
    assert "No such file or directory" in capsys.readouterr().err

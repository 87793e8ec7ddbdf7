"""One bad table for each kind of finding: `NAME.yaml` and, in `NAME.txt`, all that `router validate` says.

A table is named after the code that it shows. To write the text of a new one, from the folder above:
`router validate --strict bad_tables/NAME.yaml > bad_tables/NAME.txt`; then read it as if you had made the mistake.
Most of them extend `base/base.yaml`, which has nothing wrong in it.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from router.cli import BAD_TABLE, OK, main
from router.errors import Code

HERE = Path(__file__).parent
TABLES = sorted(HERE.glob("*.yaml"))


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_validate_says_what_is_wrong_and_where(
    table: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(HERE.parent)
    code = main(["validate", "--strict", str(table.relative_to(HERE.parent))])
    assert capsys.readouterr().out == table.with_suffix(".txt").read_text(encoding="utf-8")
    assert code == BAD_TABLE


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_a_bad_table_is_named_after_the_code_that_it_shows(table: Path) -> None:
    shown = table.with_suffix(".txt").read_text(encoding="utf-8")
    named = [code.value for code in Code if table.stem == code.value or table.stem.startswith(f"{code.value}-")]
    assert [name for name in named if f"[{name}]" in shown]


def test_what_the_bad_tables_extend_has_nothing_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "--strict", str(HERE / "base" / "base.yaml")]) == OK
    assert "base.yaml: ok (" in capsys.readouterr().out


@pytest.mark.parametrize("code", Code, ids=lambda code: code.value)
def test_every_code_has_a_bad_table(code: Code) -> None:
    shown = [table.with_suffix(".txt").read_text(encoding="utf-8") for table in TABLES]
    assert any(f"error[{code.value}]" in text for text in shown)

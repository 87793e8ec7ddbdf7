"""Each table of the corpus gets exactly the findings that stand beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, OK, main
from router.errors import Code
from tests.bad_tables.corpus import HERE, PAGES, good, sections, unpack, validate

TABLES = {page.stem: list(sections(page)) for page in PAGES}
GOOD_PROTO = """
version: 1
envelope: {{protos: protos/{protos}, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: 127.0.0.1:5000}}}}
endpoints: {{board: {{address: 127.0.0.30:8, kind: board}}}}
routes:
  note: {{source: any, destinations: board, deadman: {{none: not part of this test}}}}
"""


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    unpack(folder, [table for tables in TABLES.values() for table in tables])
    return folder


@pytest.mark.parametrize("code", TABLES)
def test_validate_says_what_is_wrong_and_where(code: str, unpacked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(unpacked)
    said = {table.name: validate(table.name) for table in TABLES[code]}
    assert said == {table.name: (BAD_TABLE, table.said) for table in TABLES[code]}


def test_a_bad_table_is_named_after_the_code_that_it_shows() -> None:
    for tables in TABLES.values():
        for table in tables:
            assert table.name == table.code or table.name.startswith(f"{table.code}-")
            assert f"[{table.code}]" in table.said


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_what_to_write_in_its_place_has_nothing_wrong(
    page: Path, unpacked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind, text = good(page)
    table = unpacked / "bad_tables" / "good.yaml"
    if kind != "yaml":
        protos = table.parent / "protos" / f"good-{page.stem}"
        protos.mkdir()
        if kind == "options":
            shutil.copy(HERE / "protos" / "options" / "envelope.proto", protos)
        (protos / f"envelope.{kind}").write_text(text)
        assert main(["schema", "lock", "--protos", str(protos)]) == OK
        text = GOOD_PROTO.format(protos=protos.name)
    table.write_text(text, encoding="utf-8")
    assert main(["validate", "--strict", str(table)]) == OK, capsys.readouterr().out


def test_what_the_bad_tables_extend_has_nothing_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "--strict", str(HERE / "base" / "base.yaml")]) == OK
    assert "base.yaml: ok (" in capsys.readouterr().out


def test_every_code_has_a_page_with_its_meaning_and_an_error() -> None:
    assert set(TABLES) == {code.value for code in Code}
    for code in Code:
        page = (HERE / f"{code.value}.md").read_text(encoding="utf-8")
        assert page.startswith(f"# {code.value}\n\n{code.meaning}\n")
        assert f"error[{code.value}]" in page

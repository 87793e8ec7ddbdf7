"""Each table of the corpus gets exactly the findings beside it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, OK, main
from router.compiler import check_table
from router.errors import Code, Diagnostic, SourceSpan
from tests.bad_tables.corpus import HERE, PAGES, BadTable, good, sections, unpack, validate

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


_OFFERED = re.compile(r"did you mean '(?P<meant>[^']+)'|write `(?P<written>[^`]+)`(?: for `(?P<instead>[^`]+)`)?")
_PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|\b[abcx]\b|\.\.\.|\$\{|^\W+$")


def _offers(table: BadTable, findings: Sequence[Diagnostic]) -> Iterator[tuple[Diagnostic, str, str]]:
    """Yield the findings of a table whose hint has a text to write, with that text and the text that it replaces."""
    for finding in findings:
        found = _OFFERED.search(finding.hint)
        if found is None or finding.span.file != f"bad_tables/{table.name}.yaml":
            continue
        text = found["meant"] or found["written"]
        if found["meant"] or not _PLACEHOLDER.search(text):
            yield finding, text, found["instead"] or ""


def _applied(line: str, span: SourceSpan, text: str, instead: str) -> Iterator[str]:
    """Yield the line with the text in place of the marked part, of similar text, of the rest of the line, or of all."""
    start, end = span.column - 1, span.end_column - 1
    before, marked, behind = line[:start], line[start:end], line[end:]
    alike = re.compile(r"[\s,:=]*".join(map(re.escape, re.findall(r"\w+|[^\w\s,:=]", text))))
    indent = re.match(r"[ -]*", line)
    if instead:
        yield line.replace(instead, text, 1)
    quote = marked[:1] if marked[:1] in ("'", '"') else '"'
    yield from (f"{before}{each}{behind}" for each in (text, f"{quote}{text}{quote}"))
    yield alike.sub(lambda _: text, line, count=1)
    yield before + text
    yield (indent[0] if indent else "") + text


def _remains(finding: Diagnostic, table: Path) -> bool:
    """Return whether a finding of a table, or another one at the same position, remains."""
    span = finding.span
    after = check_table(table).diagnostics
    same = [each for each in after if (each.code, each.message) == (finding.code, finding.message)]
    here = [each.span for each in after if each.span.line == span.line]
    return any(abs(each.span.line - span.line) <= 1 for each in same) or any(
        each.column <= span.column < each.end_column for each in here
    )


@pytest.mark.parametrize("code", TABLES)
def test_what_a_hint_offers_ends_the_finding(code: str, unpacked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(unpacked)
    useless = []
    for table in TABLES[code]:
        file = Path("bad_tables", f"{table.name}.yaml")
        lines = table.table.decode(errors="replace").split("\n")
        for finding, text, instead in _offers(table, check_table(file).diagnostics):
            number = finding.span.line
            for made in _applied(lines[number - 1], finding.span, text, instead):
                file.write_text("\n".join((*lines[: number - 1], made, *lines[number:])), encoding="utf-8")
                if not _remains(finding, file):
                    break
            else:
                useless.append(str(finding))
        file.write_bytes(table.table)
    assert useless == []


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


@pytest.mark.parametrize(
    ("name", "has"),
    [("base", "3 payload cases, 1 topic, 2 endpoints"), ("calls", "2 payload cases, 2 services, 2 endpoints")],
)
def test_what_the_bad_tables_extend_has_nothing_wrong(name: str, has: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "--strict", str(HERE / "base" / f"{name}.yaml")]) == OK
    assert f"{name}.yaml: ok ({has})" in capsys.readouterr().out


def test_every_code_has_a_page_with_its_meaning_and_an_error() -> None:
    assert set(TABLES) == {code.value for code in Code}
    for code in Code:
        page = (HERE / f"{code.value}.md").read_text(encoding="utf-8")
        assert page.startswith(f"# {code.value}\n\n{code.meaning}\n")
        assert f"error[{code.value}]" in page

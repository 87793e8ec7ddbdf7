from __future__ import annotations

import io
import re
from pathlib import Path

import pytest

from router.cli.findings import as_github, as_text, is_coloured, print_findings
from router.errors import Code, Diagnostic, SourceSpan

WARNING = Diagnostic(SourceSpan("t.yaml", 1, 1, 4), Code.UNCOVERED_PAYLOAD_CASE, "no route")
ERROR = Diagnostic(SourceSpan("t.yaml", 2, 6, 13), Code.UNKNOWN_FIELD, "no field 'accel_q'", "did you mean 'accel_x'?")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")


def excerpt(name: str, line: str, start: int, end: int) -> list[str]:
    """The lines below a finding about columns `start` to `end` of a file of one line; each test has its file."""
    Path(name).write_text(line + "\n", encoding="utf-8")
    finding = Diagnostic(SourceSpan(name, 1, start, end), Code.BAD_VALUE, "what")
    return as_text(finding, coloured=False, strict=False).splitlines()[1:]


@pytest.mark.parametrize("span", [SourceSpan("none.yaml", 3, 2, 4), SourceSpan("none\0.yaml"), SourceSpan(".")])
def test_without_a_source_line_there_is_none(span: SourceSpan) -> None:
    finding = Diagnostic(span, Code.BAD_FILE, "what")
    assert len(as_text(finding, coloured=False, strict=False).splitlines()) == 1


def test_the_caret_stands_below_what_it_marks() -> None:
    assert excerpt("tab.yaml", "\ta: b", 5, 6)[1] == "      | \t   ^"
    assert excerpt("wide.yaml", "漢字: b", 5, 6)[1] == "      |       ^"
    assert excerpt("marked.yaml", "a: 漢字", 4, 6)[1] == "      |    ^^^^"
    assert excerpt("end.yaml", "a:", 3, 3)[1] == "      |   ^"
    assert excerpt("control.yaml", "a\x1b: b", 5, 6) == ["    1 | a\\x1b: b", "      |        ^"]


def test_of_a_long_line_the_part_around_the_caret_is_shown() -> None:
    source, caret = excerpt("long.yaml", "x" * 500 + "HERE" + "y" * 500, 501, 505)
    assert source[caret.index("^") : caret.rindex("^") + 1] == "HERE"
    assert len(source) < 200


def test_a_finding_is_one_line_whatever_the_table_holds() -> None:
    finding = Diagnostic(SourceSpan("none.yaml"), Code.BAD_VALUE, "not 'a\nb\x1b[31m'")
    assert as_text(finding, coloured=False, strict=False).endswith("not 'a\\nb\\x1b[31m'")


def test_github_gets_a_workflow_command() -> None:
    assert as_github(ERROR, strict=False) == (
        "::error file=t.yaml,line=2,col=6,endColumn=13,title=unknown-field::no field 'accel_q'; did you mean 'accel_x'?"
    )
    odd = Diagnostic(SourceSpan("a,b:c%.yaml"), Code.BAD_VALUE, "100%\nx")
    assert as_github(odd, strict=False).startswith("::error file=a%2Cb%3Ac%25.yaml,")
    assert as_github(odd, strict=False).endswith("::100%25%0Ax")


def test_colour_is_for_terminals_that_want_it(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("t.yaml").write_text("abc\nabcdefghijklmn\n")
    out = Terminal()
    print_findings([ERROR], out)
    assert "\x1b[31m" in out.getvalue()
    plain = io.StringIO()
    print_findings([ERROR], plain)
    assert re.sub(r"\x1b\[\d*m", "", out.getvalue()) == plain.getvalue()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not is_coloured(out)

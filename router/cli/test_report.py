"""How `router test` tells what came of tests: for people, as JSON, as annotations of a pull request.

Knows results, not how they came about.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from router.cli.findings import as_data as finding_data
from router.cli.findings import excerpt, github_escaped, is_coloured, plural, visible
from router.errors import Diagnostic, SourceSpan, shown_path
from router.rehearsal.comparing import Failure
from router.rehearsal.coverage import Coverage
from router.rehearsal.running import Result

_RESET, _BOLD, _RED, _GREEN, _CYAN, _YELLOW = "\x1b[0m", "\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[36m", "\x1b[33m"

Coverages = Mapping[Path, Coverage]


def print_results(
    results: Sequence[Result], findings: Sequence[Diagnostic], coverages: Coverages, out: TextIO, style: str
) -> None:
    """In one of findings.FORMATS. Only JSON has the `findings`, which are what is wrong with test files and tables."""
    if style == "json":
        wrong = {"findings": [finding_data(finding, strict=False) for finding in findings]}
        json.dump(as_data(results, coverages) | wrong, out, indent=2)
        out.write("\n")
    elif style == "github":
        out.writelines(line + "\n" for line in _github(results, coverages))
    else:
        out.writelines(line + "\n" for line in _text(results, coverages, _Paint(is_coloured(out))))


def summary(results: Sequence[Result], files: int) -> str:
    """`2 of 31 tests failed, in 1 file`."""
    failed = sum(not result.passed for result in results)
    verdict = (
        f"{failed} of {plural(len(results), 'test')} failed" if failed else f"{plural(len(results), 'test')} passed"
    )
    return f"{verdict}, in {plural(files, 'file')}"


class _Paint:
    def __init__(self, coloured: bool) -> None:
        self.coloured = coloured

    def __call__(self, colour: str, text: str) -> str:
        return f"{colour}{text}{_RESET}" if self.coloured else text

    def excerpt(self, span: SourceSpan, colour: str) -> list[str]:
        return excerpt(span, colour if self.coloured else "")


# for people


def _text(results: Sequence[Result], coverages: Coverages, paint: _Paint) -> Iterator[str]:
    for result in results:
        if result.failures:
            yield f"{paint(_BOLD, str(result.test.span))}: {paint(_RED, 'failed')}: {visible(result.test.name)}"
        for failure in result.failures:
            yield from _failure(failure, paint)
            yield ""
    for path, coverage in coverages.items():
        yield from _coverage(path, coverage, paint)


def _failure(failure: Failure, paint: _Paint) -> Iterator[str]:
    yield f"{failure.span}: {paint(_BOLD, visible(failure.message))}"
    yield from paint.excerpt(failure.span, _RED)
    if failure.table is not None:
        yield f"{failure.table.span}: {paint(_CYAN, failure.table.note)}"
        yield from paint.excerpt(failure.table.span, _CYAN)


def _coverage(path: Path, coverage: Coverage, paint: _Paint) -> Iterator[str]:
    for gap in coverage.gaps():
        yield f"{gap.span}: {paint(_YELLOW, 'not covered')}: {gap.what}"
        yield from paint.excerpt(gap.span, _YELLOW)
    counts = [f"{touched} of {plural(there, kind)}" for kind, (touched, there) in coverage.counts().items()]
    yield f"{shown_path(path)}: covered {', '.join(counts)}"


# for machines


def as_data(results: Sequence[Result], coverages: Coverages) -> dict[str, object]:
    """Lines and columns count from 1, `end_column` is exclusive."""
    return {
        "tests": [_result(result) for result in results],
        "coverage": [
            {
                "table": shown_path(path),
                **{f"{kind}s": {"touched": one, "all": all_} for kind, (one, all_) in coverage.counts().items()},
                "gaps": [{"kind": gap.kind, "message": gap.what, **_place(gap.span)} for gap in coverage.gaps()],
            }
            for path, coverage in coverages.items()
        ],
    }


def _result(result: Result) -> dict[str, object]:
    failures = [
        {
            "message": failure.message,
            **_place(failure.span),
            "table": {"note": failure.table.note, **_place(failure.table.span)} if failure.table else None,
        }
        for failure in result.failures
    ]
    return {"name": result.test.name, "passed": result.passed, **_place(result.test.span), "failures": failures}


def _place(span: SourceSpan) -> dict[str, str | int]:
    return {"file": span.file, "line": span.line, "column": span.column, "end_column": span.end_column}


def _github(results: Sequence[Result], coverages: Coverages) -> Iterator[str]:
    for result in results:
        for failure in result.failures:
            table = f" ({failure.table.span}: {failure.table.note})" if failure.table else ""
            yield _annotation("error", failure.span, result.test.name, failure.message + table)
    for coverage in coverages.values():
        for gap in coverage.gaps():
            yield _annotation("warning", gap.span, "not covered by a test", gap.what)


def _annotation(level: str, span: SourceSpan, title: str, text: str) -> str:
    properties = {"file": span.file, "line": span.line, "col": span.column, "endColumn": span.end_column}
    listed = ",".join(f"{name}={github_escaped(str(value), ':,')}" for name, value in properties.items())
    return f"::{level} {listed},title={github_escaped(title, ':,')}::{github_escaped(text, '')}"

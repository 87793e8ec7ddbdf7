"""`router test PATH...`: check what tables do with messages, without network or ROS."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from router.cli import BAD_TABLE, BAD_USAGE, OK, Subparsers, add_verb
from router.cli.findings import (
    BOLD,
    CYAN,
    RED,
    YELLOW,
    Paint,
    annotation,
    as_data,
    excerpt,
    is_coloured,
    place,
    print_findings,
    visible,
)
from router.cli.tool_options import add_styles, add_tables, table_paths
from router.errors import Diagnostic, Severity, TableError, UsageError, plural, shown_path

if TYPE_CHECKING:
    from router.rehearsal.coverage import Coverage
    from router.rehearsal.running import FailedStep, Result

FAILED = 1
_DESCRIPTION = f"""Run the tests of route tables: given a message, the table must send and publish exactly what the
test expects. A table stands for the test file beside it (rover.test.yaml for rover.yaml), a folder for the *.test.yaml
and *.test.yml in it (not in its subfolders). docs/guides/test-tables.md describes the language.

Exit code: {OK} all passed, {FAILED} a test failed or --coverage found a gap, {BAD_TABLE} a test file or its table is
wrong, {BAD_USAGE} wrong usage."""


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router test", "router test routes/ --coverage", "router test --only 'the operator'")
    parser = add_verb(subparsers, "test", _DESCRIPTION, *examples)
    add_tables(parser, "a table, a test file, or a folder with test files")
    parser.add_argument("--coverage", action="store_true", help="list the parts of the tables that no test covers")
    parser.add_argument("--only", metavar="TEXT", help="run only tests with this text in their name")
    add_styles(parser)


def run(args: argparse.Namespace) -> int:
    from router.rehearsal.reading import find_test_files

    if args.coverage and args.only:
        print("router test: --coverage needs all tests; leave out --only", file=sys.stderr)
        return BAD_USAGE
    paths = [_tests_of(path) for path in table_paths(args)]
    files = find_test_files(paths)
    if not files:
        print(f"router test: no tests (*.test.yaml) in {', '.join(map(str, paths))}", file=sys.stderr)
        return BAD_USAGE
    coverages: dict[Path, Coverage] = {}
    results, findings = _results(files, args.only or "", coverages if args.coverage else None)
    if args.only and not results and not findings:
        print(f"router test: no test has {args.only!r} in its name", file=sys.stderr)
        return BAD_USAGE
    if findings and args.style != "json":
        print_findings(findings, sys.stderr, args.style)
    _print_results(results, findings, coverages.values(), sys.stdout, args.style)
    if args.style == "text" and (results or not findings):
        print(_summary(results, len(files)))
    if findings:
        return BAD_TABLE
    is_complete = all(coverage.is_complete for coverage in coverages.values())
    return OK if is_complete and all(result.passed for result in results) else FAILED


def _tests_of(path: Path) -> Path:
    """Return the test file beside a table; any other path unchanged. Raises UsageError or TableError."""
    from router.table.source import TEST_ENDINGS

    if not path.is_file() or path.name.endswith(TEST_ENDINGS):
        return path
    tests = path.with_name(f"{path.stem}.test{path.suffix}")
    if not tests.exists():
        from router.compiler import check_table

        if (checked := check_table(path)).has_errors:
            raise TableError(checked.diagnostics)
        raise UsageError(f"{shown_path(path)} has no tests: there is no {shown_path(tests)}")
    return tests


def _results(
    files: Sequence[Path], only: str, coverages: dict[Path, Coverage] | None
) -> tuple[list[Result], list[Diagnostic]]:
    """Run the tests. Return all results, and the findings in test files and tables. Fill `coverages`, by table."""
    from router.compiler.lookup import Definitions
    from router.rehearsal.coverage import Coverage
    from router.rehearsal.reading import read_test_file
    from router.rehearsal.running import run_tests
    from router.table import in_order

    results: list[Result] = []
    findings: dict[Diagnostic, None] = {}
    definitions = Definitions()
    for path in files:
        try:
            file = read_test_file(path, definitions)
        except TableError as error:
            findings.update(dict.fromkeys(error.diagnostics))
            continue
        coverage = None if coverages is None else Coverage(file.checked, file.program)
        results += run_tests(file, only, coverage)
        if coverages is not None and coverage is not None:
            coverages.setdefault(file.checked.path, coverage).add(coverage)
    for coverage, other in itertools.permutations((coverages or {}).values(), 2):
        coverage.inherit(other)
    findings.update(dict.fromkeys(finding for result in results for finding in result.findings))
    return results, in_order(list(findings))


def _print_results(
    results: Sequence[Result], findings: Sequence[Diagnostic], coverages: Collection[Coverage], out: TextIO, style: str
) -> None:
    """Print in one of FORMATS. Only JSON contains `findings`, those in test files and tables."""
    if style == "json":
        wrong = {"findings": [as_data(finding, strict=False) for finding in findings]}
        print(json.dumps(_as_data(results, coverages) | wrong, indent=2), file=out)
    elif style == "github":
        out.writelines(line + "\n" for line in _annotations(results, coverages))
    else:
        out.writelines(line + "\n" for line in _text(results, coverages, Paint(is_coloured(out))))


def _summary(results: Sequence[Result], files: int) -> str:
    """Return `2 of 31 tests failed, in 1 file`."""
    failed = sum(not result.passed for result in results)
    tests = plural(len(results), "test")
    return f"{f'{failed} of {tests} failed' if failed else f'{tests} passed'}, in {plural(files, 'file')}"


# for people


def _text(results: Sequence[Result], coverages: Collection[Coverage], paint: Paint) -> Iterator[str]:
    for result in results:
        if result.failures:
            yield f"{paint(BOLD, str(result.test.span))}: {paint(RED, 'failed')}: {visible(result.test.name)}"
        for step in result.failed:
            yield from _failed_step(step, paint)
    for coverage in coverages:
        for item in coverage.gaps():
            yield f"{item.span}: {paint(YELLOW, 'not covered')}: {item.gap}"
            yield from excerpt(item.span, paint, YELLOW)
        counts = [f"{touched} of {plural(there, kind)}" for kind, (touched, there) in coverage.counts().items()]
        yield f"{shown_path(coverage.path)}: covered {', '.join(counts)}"


def _failed_step(step: FailedStep, paint: Paint) -> Iterator[str]:
    for failure in step.failures:
        yield f"{failure.span}: {paint(BOLD, visible(failure.message))}"
        yield from excerpt(failure.span, paint, RED)
        if failure.table is not None:
            yield f"{failure.table.span}: {paint(CYAN, failure.table.note)}"
            yield from excerpt(failure.table.span, paint, CYAN)
        yield ""
    if len(step.events) > 1:
        yield "what happened in this step, in order:"
        yield from (f"    {visible(line)}" for line in step.events)
        yield ""


# for machines


def _as_data(results: Sequence[Result], coverages: Collection[Coverage]) -> dict[str, object]:
    return {
        "tests": [_result_data(result) for result in results],
        "coverage": [
            {
                "table": shown_path(coverage.path),
                **{f"{kind}s": {"touched": one, "all": all_} for kind, (one, all_) in coverage.counts().items()},
                "gaps": [{"kind": item.kind, "message": item.gap, **place(item.span)} for item in coverage.gaps()],
            }
            for coverage in coverages
        ],
    }


def _result_data(result: Result) -> dict[str, object]:
    failures = [
        {
            "message": failure.message,
            **place(failure.span),
            "table": {"note": failure.table.note, **place(failure.table.span)} if failure.table else None,
        }
        for failure in result.failures
    ]
    return {"name": result.test.name, "passed": result.passed, **place(result.test.span), "failures": failures}


def _annotations(results: Sequence[Result], coverages: Collection[Coverage]) -> Iterator[str]:
    for result in results:
        for failure in result.failures:
            table = f" ({failure.table.span}: {failure.table.note})" if failure.table else ""
            yield annotation(Severity.ERROR, failure.span, result.test.name, failure.message + table)
    for coverage in coverages:
        for item in coverage.gaps():
            yield annotation(Severity.WARNING, item.span, "not covered by a test", item.gap)

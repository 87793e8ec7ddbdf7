"""`router test PATH...`: proves what tables do with messages, without network or ROS."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from router.cli import BAD_TABLE, BAD_USAGE, OK, VERBS
from router.cli.findings import FORMATS, print_findings
from router.cli.test_report import print_results, summary
from router.compiler.lookup import Definitions
from router.errors import Diagnostic, TableError
from router.rehearsal.coverage import Coverage
from router.rehearsal.reading import read_test_file
from router.rehearsal.running import Result
from router.rehearsal.tests import find_test_files, prove
from router.table import in_order

FAILED = 1
DEFAULT = Path("routes")
_DESCRIPTION = f"""Run the tests of route tables: given this message, the table sends and publishes exactly that.
A folder stands for the *.test.yaml and *.test.yml in it (not in folders below it); without a PATH it is '{DEFAULT}'.
docs/testing-tables.md has the language. Exit code: {OK} all passed, {FAILED} a test failed or --coverage found a gap,
{BAD_TABLE} a test file or its table is wrong, {BAD_USAGE} wrong usage."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("test", help=VERBS["test"], description=_DESCRIPTION)
    parser.add_argument("paths", metavar="PATH", nargs="*", type=Path, help="a test file, or a folder with test files")
    parser.add_argument("--coverage", action="store_true", help="list what of the tables no test has touched")
    parser.add_argument("--only", metavar="TEXT", help="run the tests whose name contains this")
    parser.add_argument("--format", choices=FORMATS, default="text", help="how results are written (default: text)")


def run(args: argparse.Namespace) -> int:
    if args.coverage and args.only:
        print("router test: --coverage is about all tests; leave out --only", file=sys.stderr)
        return BAD_USAGE
    paths = args.paths or [DEFAULT]
    files = find_test_files(paths)
    if not files:
        print(f"router test: no tests (*.test.yaml) in {', '.join(map(str, paths))}", file=sys.stderr)
        return BAD_USAGE
    coverages: dict[Path, Coverage] | None = {} if args.coverage else None
    results, findings = _proven(files, args.only or "", coverages)
    if args.only and not results and not findings:
        print(f"router test: the name of no test contains {args.only!r}", file=sys.stderr)
        return BAD_USAGE
    if findings and args.format != "json":
        print_findings(findings, sys.stderr, args.format)
    print_results(results, findings, coverages or {}, sys.stdout, args.format)
    if args.format == "text" and (results or not findings):
        print(summary(results, len(files)))
    if findings:
        return BAD_TABLE
    is_complete = all(coverage.is_complete for coverage in (coverages or {}).values())
    return OK if is_complete and all(result.passed for result in results) else FAILED


def _proven(
    files: Sequence[Path], only: str, coverages: dict[Path, Coverage] | None
) -> tuple[list[Result], list[Diagnostic]]:
    """All results, and what is wrong with the test files and their tables. `coverages`, by table, are filled."""
    results: list[Result] = []
    findings: dict[Diagnostic, None] = {}
    definitions = Definitions()
    for path in files:
        try:
            file = read_test_file(path, definitions)
        except TableError as error:
            findings.update(dict.fromkeys(error.diagnostics))
            continue
        coverage = None if coverages is None else Coverage.of(file)
        results += prove(file, only, coverage)
        if coverages is not None and coverage is not None:
            coverages.setdefault(file.checked.path, coverage).add(coverage)
    for coverage, other in itertools.permutations((coverages or {}).values(), 2):
        coverage.learn(other)
    findings.update(dict.fromkeys(finding for result in results for finding in result.findings))
    return results, in_order(list(findings))

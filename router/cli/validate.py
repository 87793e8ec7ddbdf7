"""`router validate PATH...`: every finding of route tables. Needs neither ROS nor a network."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from router.cli import BAD_TABLE, BAD_USAGE, OK, VERBS
from router.cli.findings import FORMATS, count_line, print_findings, severity
from router.compiler import check_table
from router.compiler.lookup import Definitions
from router.errors import Diagnostic, Severity, UsageError, shown_path
from router.table import summary

DEFAULT = Path("routes")
_DESCRIPTION = f"""Report every finding in the tables, with file, line, column and a hint.
A folder stands for the *.yaml and *.yml in it (not in folders below it, and not *.test.yaml);
without a PATH it is '{DEFAULT}'. Exit code: {OK} clean, {BAD_TABLE} errors, {BAD_USAGE} wrong usage."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("validate", help=VERBS["validate"], description=_DESCRIPTION)
    parser.add_argument("paths", metavar="PATH", nargs="*", type=Path, help="a table, or a folder with tables")
    parser.add_argument("--format", choices=FORMATS, default="text", help="how findings are written (default: text)")
    parser.add_argument("--strict", action="store_true", help="take warnings for errors")


def run(args: argparse.Namespace) -> int:
    tables = find_tables(args.paths or [DEFAULT])
    findings: dict[Diagnostic, None] = {}  # tables that extend the same one share its findings
    definitions = Definitions()
    for path in tables:
        checked = check_table(path, definitions=definitions)
        findings.update(dict.fromkeys(checked.diagnostics))
        if args.format == "text" and checked.table and not checked.diagnostics:
            print(f"{shown_path(path)}: ok ({summary(checked.table)})")
    print_findings(list(findings), sys.stdout, args.format, strict=args.strict)
    if args.format == "text" and findings:
        print(count_line(list(findings), len(tables), strict=args.strict))
    wrong = any(severity(finding, strict=args.strict) is Severity.ERROR for finding in findings)
    return BAD_TABLE if wrong else OK


def find_tables(paths: Sequence[Path]) -> list[Path]:
    """The files that the paths stand for, each once. Raises UsageError; a file need not exist."""
    tables: dict[Path, None] = {}
    for path in paths:
        if not os.path.isdir(path):  # noqa: PTH112  (Path.is_dir raises where a folder above is not ours to read)
            tables[path] = None
            continue
        try:
            found = sorted(file for file in path.iterdir() if _is_table(file))
        except OSError as error:
            raise UsageError(f"the folder '{path}' cannot be read: {error.strerror}") from error
        if not found:
            raise UsageError(f"the folder '{path}' has no route table (*.yaml, *.yml)")
        tables.update(dict.fromkeys(found))
    return list(tables)


def _is_table(file: Path) -> bool:
    is_yaml = file.suffix in (".yaml", ".yml") and not file.name.endswith((".test.yaml", ".test.yml"))
    return is_yaml and not file.name.startswith(".") and not file.is_dir()

"""`router validate PATH...`: print every finding in route tables. Needs neither ROS nor a network."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from router.cli import BAD_TABLE, BAD_USAGE, OK, Subparsers, add_verb
from router.cli.findings import count_line, print_findings, severity
from router.cli.tool_options import add_styles, add_tables, table_paths
from router.errors import Diagnostic, Severity, UsageError, shown_path

_DESCRIPTION = f"""Report every finding in the tables, with file, line, column and a hint. A folder stands for the
*.yaml and *.yml in it (not in its subfolders, and not *.test.yaml).

Exit code: {OK} clean, {BAD_TABLE} errors, {BAD_USAGE} wrong usage."""


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router validate", "router validate routes/ --strict", "router validate routes/ --github")
    parser = add_verb(subparsers, "validate", _DESCRIPTION, *examples)
    add_tables(parser, "a table, or a folder with tables")
    add_styles(parser)
    parser.add_argument("--strict", action="store_true", help="treat warnings as errors")


def run(args: argparse.Namespace) -> int:
    from router.compiler import check_table
    from router.compiler.lookup import Definitions
    from router.table import summary

    tables = find_tables(table_paths(args))
    findings: dict[Diagnostic, None] = {}  # tables that extend the same one share its findings
    definitions = Definitions()
    for path in tables:
        checked = check_table(path, definitions=definitions)
        findings.update(dict.fromkeys(checked.diagnostics))
        if args.style == "text" and checked.table and not checked.diagnostics:
            print(f"{shown_path(path)}: ok ({summary(checked.table)})")
    print_findings(list(findings), sys.stdout, args.style, strict=args.strict)
    if args.style == "text" and findings:
        print(count_line(list(findings), len(tables), strict=args.strict))
    wrong = any(severity(finding, strict=args.strict) is Severity.ERROR for finding in findings)
    return BAD_TABLE if wrong else OK


def find_tables(paths: Sequence[Path]) -> list[Path]:
    """Return the files that the paths stand for, each once; they need not exist. Raises UsageError."""
    tables: dict[Path, None] = {}
    for path in paths:
        if not os.path.isdir(path):  # noqa: PTH112  (Path.is_dir raises if a parent folder is not readable)
            tables[path] = None
            continue
        try:
            inside = sorted(file for file in path.iterdir() if _is_table(file))
        except OSError as error:
            raise UsageError(f"the folder '{path}' cannot be read: {error.strerror}") from error
        if not inside:
            raise UsageError(f"the folder '{path}' has no route table (*.yaml, *.yml)")
        tables.update(dict.fromkeys(inside))
    return list(tables)


def _is_table(file: Path) -> bool:
    from router.table.source import TEST_ENDINGS

    is_yaml = file.suffix in (".yaml", ".yml") and not file.name.endswith(TEST_ENDINGS)
    return is_yaml and not file.name.startswith(".") and not file.is_dir()

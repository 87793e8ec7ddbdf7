"""`router dashboard [TABLE]`: a Grafana dashboard of a table, to be imported or provisioned."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from router.cli import BAD_TABLE, DEFAULT_TABLE, OK, VERBS
from router.cli.findings import print_findings

_DESCRIPTION = """Print a Grafana dashboard, as JSON: an overview, a row for each endpoint and gateway, and in it what
each route received, delivered and dropped, when it last did, and how long it took."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("dashboard", help=VERBS["dashboard"], description=_DESCRIPTION)
    parser.add_argument(
        "table", nargs="?", type=Path, default=DEFAULT_TABLE, metavar="TABLE", help="route table (default: %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    from router.compiler import check_table
    from router.tools.dashboard import dashboard

    checked = check_table(args.table)
    print_findings(checked.diagnostics, sys.stderr)
    if checked.program is None:
        return BAD_TABLE
    print(json.dumps(dashboard(checked.program), indent=2))
    return OK

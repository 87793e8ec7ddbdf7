"""`router explain --diff OLD NEW`: what one table does otherwise than another, a line each.

Prints what `router.tools.differences` found; finds out nothing itself.
"""

from __future__ import annotations

import sys
from pathlib import Path

from router.cli import BAD_TABLE, OK
from router.cli.findings import print_findings
from router.compiler import check_table
from router.compiler.lookup import Definitions
from router.tools.differences import differences


def print_differences(old: Path, new: Path) -> int:
    definitions = Definitions()
    tables = [check_table(path, definitions=definitions) for path in (old, new)]
    findings = dict.fromkeys(finding for checked in tables for finding in checked.diagnostics)
    print_findings(list(findings), sys.stderr)
    if any(checked.has_errors for checked in tables):
        return BAD_TABLE
    found = differences(*tables)
    for each in found:
        print(f"{each.subject}{each.part and ', '}{each.part}: {each.text}  ({each.span})")
    if not found:
        print(f"{new} does what {old} does")
    return OK

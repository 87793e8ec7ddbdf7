"""`router doctor`: find what keeps a router from working on this computer, and print the remedies."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from typing import TYPE_CHECKING, TextIO

from router.cli import BAD_TABLE, OK, Subparsers, add_verb
from router.cli.findings import GREEN, RED, YELLOW, Paint, is_coloured, wrapped
from router.cli.tool_options import add_table, table_path
from router.errors import plural

if TYPE_CHECKING:
    from router.tools.doctor_checks import CheckResult, Grade

SICK = 1

_DESCRIPTION = f"""Check the table, ROS, ports, buffers, clock, endpoints and the running router, if there is one.
Exit code: {OK} no problems, {SICK} problems, {BAD_TABLE} the table cannot be read. Warnings do not change the exit
code."""

_STYLES = {"ok": GREEN, "warning": YELLOW, "problem": RED}
"""Styles by the value of a grade."""

_COLUMN = 20
"""The column at which texts begin."""


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "doctor", _DESCRIPTION, "router doctor", "router doctor -t routes/sim.yaml")
    add_table(parser)
    parser.add_argument(
        "--pre-start",
        action="store_true",
        help="report only what would make the start fail, missing networks and other routers; print nothing else",
    )
    parser.add_argument("--json", action="store_true", help="print each result as JSON on one line")


def run(args: argparse.Namespace) -> int:
    from router.tools.doctor import before_start, examine
    from router.tools.doctor_checks import Grade

    path = table_path(args)
    grades: Counter[Grade] = Counter()
    for result in (before_start if args.pre_start else examine)(path, os.environ):
        grades[result.grade] += 1
        print(_json(result) if args.json else shown(result, sys.stdout), flush=True)
    if not args.pre_start and not args.json:
        print(_summary(grades))
    if not os.access(path, os.R_OK):
        return BAD_TABLE
    return SICK if grades[Grade.PROBLEM] else OK


def shown(result: CheckResult, out: TextIO) -> str:
    """Return the result on one line, and its remedy, if there is one, on a second line; on a terminal, wrapped."""
    grade = f"{result.grade.value:8}"
    text = wrapped(f"{grade} {result.about:10} {result.text}", out, _COLUMN)
    painted = Paint(is_coloured(out))(_STYLES[result.grade.value], grade) + text.removeprefix(grade)
    return "\n".join((painted, wrapped(f"{'':{_COLUMN}}-> {result.remedy}", out, 3))) if result.remedy else painted


def _json(result: CheckResult) -> str:
    return json.dumps(result._asdict() | {"grade": result.grade.value})


def _summary(grades: Counter[Grade]) -> str:
    from router.tools.doctor_checks import Grade

    if not grades[Grade.PROBLEM] and not grades[Grade.WARNING]:
        return "nothing keeps the router from working here"
    counts = [plural(grades[grade], grade.value) for grade in (Grade.PROBLEM, Grade.WARNING) if grades[grade]]
    return ", ".join(counts)

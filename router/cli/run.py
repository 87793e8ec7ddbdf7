"""`router run [TABLE] [--ros-args ...]`: compile the table, open everything, route until a signal says stop."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from router.cli import BAD_TABLE, OK, VERBS
from router.cli.findings import print_findings
from router.compiler import check_table
from router.edges.log import LEVELS as LOG_LEVELS
from router.edges.log import configure_log
from router.runtime import Router, tune_interpreter

DEFAULT_TABLE = Path("routes/rover.yaml")

_DESCRIPTION = f"""Routes as a table says, until SIGINT or SIGTERM.
Exit code: {OK} stopped, {BAD_TABLE} the table has errors, or what it names cannot be opened."""

_EPILOG = """\
A ROS parameter is a variable of the table in lower case, and wins over the environment:
  router run routes/legacy.yaml --ros-args -p listen_port:=5001 -p dst_ip:=127.0.0.1
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "run",
        help=VERBS["run"],
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "table", type=Path, nargs="?", default=DEFAULT_TABLE, metavar="TABLE", help="route table (default: %(default)s)"
    )
    parser.add_argument("--log-level", choices=LOG_LEVELS, default="info", help="(default: %(default)s)")
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], metavar="ARG", help="everything from here on is for ROS"
    )


def run(args: argparse.Namespace) -> int:
    configure_log(args.log_level)
    checked = check_table(args.table, {**os.environ, **table_variables(args.ros_args)})
    print_findings(checked.diagnostics, sys.stderr)
    if checked.program is None:
        return BAD_TABLE
    # Blocked in all threads, the signals wait for sigwait: no handler runs, no system call is interrupted.
    ending = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    with Router(checked.program, ["--ros-args", *args.ros_args]):
        tune_interpreter()
        signal.sigwait(ending)
        for number in ending:
            signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ending)
    return OK


def table_variables(ros_args: Sequence[str]) -> dict[str, str]:
    """`["-p", "listen_port:=5001"]` -> `{"LISTEN_PORT": "5001"}`; a node's name before the parameter's is left out."""
    assignments = (word.partition(":=") for option, word in pairwise(ros_args) if option in ("-p", "--param"))
    return {name.rpartition(":")[2].upper(): value.strip("'\"") for name, _, value in assignments if value}

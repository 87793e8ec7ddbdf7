"""`router init [DIR]`: copy `routes/`, `protos/` and `schemas/` of the router into a folder.

The layout is that of a checkout, so that the documentation holds for both.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from router.assets import asset
from router.cli import OK, VERBS
from router.errors import UsageError, shown_path

_PARTS = {
    "routes": "the example tables and their test: `router validate`, `router test`",
    "protos": "what boards and basestation send: after a change, `router schema lock --protos protos`",
    "schemas": "for editors, and `comms`, the ROS messages of the tables; colcon builds them (docs/ros.md)",
}
_DESCRIPTION = """Copy what comes with the router into a folder, to run it and to change it there. Where there is
one of them already, nothing is written."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("init", help=VERBS["init"], description=_DESCRIPTION)
    parser.add_argument("folder", metavar="DIR", nargs="?", type=Path, default=Path(), help="default: where you are")


def run(args: argparse.Namespace) -> int:
    targets = {part: args.folder / part for part in _PARTS}
    try:
        for target in targets.values():
            if target.exists():
                raise UsageError(f"{shown_path(target)} is there already; nothing was written")
        for part, target in targets.items():
            shutil.copytree(asset(part), target, copy_function=shutil.copyfile)  # drops read-only modes
            print(f"{shown_path(target)}: {_PARTS[part]}")
    except OSError as error:
        raise UsageError(str(error)) from error
    return OK

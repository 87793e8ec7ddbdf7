"""`router init DIR`: write a first table with its protos and its test, or copy the rover's files."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import sys
from pathlib import Path

from router.assets import asset, is_installed
from router.cli import BAD_TABLE, OK, Subparsers, add_verb
from router.cli.findings import print_findings
from router.errors import UsageError, plural, shown_path

FIRST_TABLE = Path(__file__).parents[1] / "tools" / "first_table"

_FIRST = {
    "routes": "rover.yaml, the table, and rover.test.yaml, its tests",
    "protos": "the board's messages, and the lock of their field numbers",
}
_ROVER = {
    "routes": "the rover's tables and their test",
    "protos": "the messages of its boards and basestation",
    "schemas": "schemas for editors, and its ROS messages, 'comms'; colcon builds them (docs/guides/ros-workspace.md)",
}
_DESCRIPTION = """Write a first table into a folder: one board and one topic, on this computer, with a simulator for
the board. With --rover, write the rover's own tables, protos and ROS messages instead, to run and change. With
--protos, propose a table for the messages of another robot: its envelope, and a route for each payload. If one of the
folders already exists, nothing is written."""
_PROTOS = "folder of another robot's .proto files, which stay where they are"
_MESSAGE = "with --protos, the envelope (default: the likeliest message)"
_EXAMPLES = ("router init robot", "router init --rover .", "router init robot --protos vendor/protos")


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "init", _DESCRIPTION, *_EXAMPLES)
    parser.add_argument("folder", metavar="DIR", type=Path, help="created if it does not exist")
    parts = parser.add_mutually_exclusive_group()
    parts.add_argument("--rover", action="store_true", help="the rover's tables, protos and ROS messages")
    parts.add_argument("--protos", type=Path, metavar="PROTOS", help=_PROTOS)
    parser.add_argument("--message", metavar="NAME", help=_MESSAGE)


def _rover_parts() -> dict[str, str]:
    """Return the files that come with the router. In a wheel, the protos are in the folders that the tables name."""
    folder = asset("routes").parent
    if not is_installed(folder):
        return _ROVER
    names = [name for name in _ROVER if (folder / name).exists()]
    names += sorted({path.name for path in folder.iterdir()} - _ROVER.keys())
    other = {True: _ROVER["protos"], False: "its field numbers"}
    return {name: _ROVER.get(name, other[(folder / name).is_dir()]) for name in names}


def run(args: argparse.Namespace) -> int:
    if args.protos is not None:
        return _propose(args)
    if args.message is not None:
        raise UsageError("--message is the envelope among the messages of --protos", "name their folder: --protos DIR")
    parts = _rover_parts() if args.rover else _FIRST
    targets = {part: args.folder / part for part in parts}
    try:
        for target in targets.values():
            if target.exists():
                raise UsageError(f"{shown_path(target)} already exists; nothing was written")
        for part, target in targets.items():
            source = asset(part) if args.rover else FIRST_TABLE / part
            if source.is_dir():
                shutil.copytree(source, target, copy_function=shutil.copyfile)  # drops read-only modes
            else:
                shutil.copyfile(source, target)
    except OSError as error:
        raise UsageError(f"{args.folder} cannot be written: {error.strerror or error}") from error
    for part, target in targets.items():
        print(f"{shown_path(target)}: {parts[part]}")
    print(_next_steps(args.folder, "router validate && router test", "routes/sim.yaml" if args.rover else ""))
    return OK


def _propose(args: argparse.Namespace) -> int:
    """Write a proposed table and its lock, and check it. Raises TableError for broken `.proto` files."""
    from router.compiler import check_table
    from router.errors import Located, SourceSpan
    from router.tools.proposal import candidates, table_text
    from router.types.lock import LockComparison
    from router.types.lock_file import write_lock
    from router.types.protobuf import load_folder

    routes = args.folder / "routes"
    if routes.exists():
        raise UsageError(f"{shown_path(routes)} already exists; nothing was written")
    schema = load_folder(Located(args.protos.absolute(), SourceSpan(shown_path(args.protos))))
    envelope, *others = candidates(schema, args.message)
    try:
        routes.mkdir(parents=True)
        protos = Path(os.path.relpath(args.protos.resolve(), routes.resolve())).as_posix()
        table = routes / "rover.yaml"
        table.write_text(table_text(envelope, others, protos), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{args.folder} cannot be written: {error.strerror or error}") from error
    checked = check_table(table)
    print(f"{shown_path(table)}: {envelope.message.name}, {plural(len(envelope.cases), 'payload case')}")
    if checked.envelopes is not None:
        lock = LockComparison(checked.envelopes.first)
        write_lock(lock.path, lock.extended())
        print(f"{shown_path(lock.path)}: the lock of its field numbers")
    checked = check_table(table)
    print_findings([*schema.warnings, *checked.diagnostics], sys.stderr)
    print(_next_steps(args.folder, "router validate"))
    return BAD_TABLE if checked.has_errors else OK


def _next_steps(folder: Path, checks: str, run: str = "") -> str:
    """Return the steps after `init`; `run` is the table to run if it is not the default one."""
    table = f" -t {run}" if run else ""
    steps = {
        f"cd {shlex.quote(str(folder))}": "" if folder.resolve() != Path.cwd() else None,
        checks: "",
        f"router run{table}": "    # until Ctrl-C; prints the address of its status page",
        f"router sim{table}": "    # in another terminal: simulates the boards",
    }
    shown = [f"  {step}{note}" for step, note in steps.items() if note is not None]
    return "\n".join(["", "next:", *shown])

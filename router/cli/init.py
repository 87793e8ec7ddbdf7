"""`router init DIR`: write a first table with its protos and its test, or copy the rover's files."""

from __future__ import annotations

import argparse
import shlex
import shutil
from pathlib import Path

from router.assets import asset, is_installed
from router.cli import OK, Subparsers, add_verb
from router.errors import UsageError, shown_path

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
the board. With --rover, write the rover's own tables, protos and ROS messages instead, to run and change. If
one of the folders already exists, nothing is written."""


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "init", _DESCRIPTION, "router init robot", "router init --rover .")
    parser.add_argument("folder", metavar="DIR", type=Path, help="created if it does not exist")
    parser.add_argument("--rover", action="store_true", help="the rover's tables, protos and ROS messages")


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
    print(_next_steps(args.folder, is_rover=args.rover))
    return OK


def _next_steps(folder: Path, *, is_rover: bool) -> str:
    table = " -t routes/sim.yaml" if is_rover else ""
    steps = {
        f"cd {shlex.quote(str(folder))}": "" if folder.resolve() != Path.cwd() else None,
        "router validate && router test": "",
        f"router run{table}": "    # until Ctrl-C; prints the address of its status page",
        f"router sim{table}": "    # in another terminal: simulates the boards",
    }
    shown = [f"  {step}{note}" for step, note in steps.items() if note is not None]
    return "\n".join(["", "next:", *shown])

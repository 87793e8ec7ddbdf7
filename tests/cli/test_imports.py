"""What a verb imports before it answers: each package costs 5 to 50 ms, which a person or a script waits for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from router.cli import VERBS
from tests.tables import RIG

_CHILD = """
import json, os, sys
os._exit = sys.exit  # of argcomplete, which would end the process before the listing is written
before = set(sys.modules)
try:
    from router import main
    main(sys.argv[2:])
finally:
    with open(sys.argv[1], "w") as out:
        json.dump(sorted(set(sys.modules) - before), out)
"""

GROUND = {"assets", "cli", "clock", "errors", "hosts", "inputs", "log", "shortage", "types"}
"""Packages of this project that cost nothing, or that arguments are about."""
COMPILING = {"google", "grpc_tools", "yaml"}
"""What a table without errors takes."""
HEAVY = COMPILING | {
    "jsonschema",
    "asyncio",
    "argcomplete",
    "importlib.metadata",
    "mcap",
    "msgspec",
    "numpy",
    "orjson",
    "prometheus_client",
    "rclpy",
    "rich",
    "rosbags",
    "structlog",
    "websockets",
    "zenoh",
    "zstandard",
}
"""What costs most, of others and of Python."""


class Imported(NamedTuple):
    """`packages`: of this project, but for GROUND; `heavy`: those of HEAVY."""

    packages: set[str]
    heavy: set[str]


def imported(folder: Path, *arguments: str, **variables: str) -> Imported:
    """What a process imports that runs `router` with these arguments in the folder of tests/rover/."""
    listing = folder / "modules.json"
    environ = {name: value for name, value in os.environ.items() if name not in {"ROUTER_TABLE", "COMP_LINE"}}
    command = [sys.executable, "-c", _CHILD, str(listing), *arguments]
    subprocess.run(command, cwd=RIG, env=environ | variables, capture_output=True, check=False, timeout=60)
    modules = json.loads(listing.read_text())
    own = {name.split(".")[1] for name in modules if name.startswith("router.")}
    return Imported(own - GROUND, HEAVY.intersection(modules))


@pytest.mark.parametrize(
    "arguments",
    ["--help", "--version", "--nonsense", "nonsense", *(f"{verb} --help" for verb in VERBS)],
)
def test_help_and_mistakes_need_no_library(arguments: str, tmp_path: Path) -> None:
    found = imported(tmp_path, *arguments.split())
    assert found.heavy == set()
    assert found.packages == set()


def test_status_reads_an_address_and_asks_there(tmp_path: Path) -> None:
    found = imported(tmp_path, "status")
    assert found.heavy == {"yaml"}
    assert found.packages == {"net", "observe", "table", "tools"}


@pytest.mark.parametrize(("verb", "control"), [("status", set()), ("reload", {"net"})])
def test_what_is_at_a_url_needs_no_table(verb: str, control: set[str], tmp_path: Path) -> None:
    found = imported(tmp_path, verb, "--url", "http://127.0.0.1:9")
    assert found.heavy == set()
    assert found.packages == {"observe", "tools"} | control


@pytest.mark.parametrize("arguments", ["validate", "validate routes/ --strict", "test routes/", "explain imu_info"])
def test_checks_of_tables_take_the_compiler_only(arguments: str, tmp_path: Path) -> None:
    assert imported(tmp_path, *arguments.split()).heavy == COMPILING


@pytest.mark.parametrize(
    ("line", "heavy"),
    [
        ("router va", set[str]()),
        ("router validate --str", set[str]()),
        ("router explain im", {"yaml"}),
        ("router tap --from ", {"yaml"}),
    ],
)
def test_completion_takes_what_the_word_is_about(line: str, heavy: set[str], tmp_path: Path) -> None:
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words"), "COMP_LINE": line}
    found = imported(tmp_path, COMP_POINT=str(len(line)), COMP_TYPE="9", **asked)
    assert (tmp_path / "words").stat().st_size
    assert found.heavy == heavy | {"argcomplete"}

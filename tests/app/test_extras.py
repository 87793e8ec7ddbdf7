"""The router in an environment without the packages of extras, which is a copy of this one by links."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Collection
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from router.compiler.extras import EXTRAS, extra_of
from tests.ports import free_port
from tests.routers import ROOT, log_until_started
from tests.tables import PROTOS

BAD_TABLE = 78
UDP = f"""version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: "127.0.0.1:PORT"}}}}
endpoints:
  sensor_board: {{address: 127.0.0.30:25008, kind: board}}
  basestation: {{address: 127.0.0.10:29000, kind: basestation}}
routes:
  ph_info: {{source: sensor_board, destinations: basestation}}
"""
GATEWAY = """version: 1
gateways:
  dashboard: {transport: {websocket: "127.0.0.1:PORT"}}
"""


class Environment:
    """A Python with all packages of this one, except for the modules of extras."""

    def __init__(self, folder: Path, hidden: Collection[str]) -> None:
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
        self.python = folder / "bin" / "python"
        ours = Path(sysconfig.get_path("purelib"))
        [theirs] = folder.glob("lib/python3*/site-packages")
        for each in ours.iterdir():
            if each.name.partition(".")[0] not in hidden:
                (theirs / each.name).symlink_to(each)

    def router(self, folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.python, "-m", "router", *map(str, arguments)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )


def tops(extras: Collection[str]) -> set[str]:
    """The modules of extras, each without what contains it."""
    return {name.partition(".")[0] for extra in extras for name in EXTRAS[extra]}


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    return Environment(tmp_path_factory.mktemp("bare") / "venv", tops(EXTRAS))


def table(folder: Path, text: str) -> str:
    (folder / "table.yaml").write_text(text.replace("PORT", str(free_port())))
    return "table.yaml"


REFUSED = {
    "gateways": (GATEWAY, "3:3: a gateway needs", "backports.zstd, msgspec, orjson, websockets and zenoh"),
    "recording": (UDP + "record: {directory: recordings}\n", "9:1: 'record' needs", "mcap and zstandard"),
    "foxglove": (UDP + 'foxglove: {address: "127.0.0.1:PORT"}\n', "9:1: 'foxglove' needs", "mcap and websockets"),
}


@pytest.mark.parametrize("extra", EXTRAS)
def test_a_table_that_needs_an_extra_does_not_start_and_says_how_to_install_it(
    bare: Environment, tmp_path: Path, extra: str
) -> None:
    text, who, modules = REFUSED[extra]
    finished = bare.router(tmp_path, "run", table(tmp_path, text))
    assert finished.returncode == BAD_TABLE, finished.stderr
    assert f"table.yaml:{who} Python packages that are not installed: {modules}\nhelp: run " in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not (tmp_path / "recordings").exists()


@pytest.mark.parametrize("extra", EXTRAS)
def test_doctor_says_that_it_would_not_start(bare: Environment, tmp_path: Path, extra: str) -> None:
    text, who, _ = REFUSED[extra]
    finished = bare.router(tmp_path, "doctor", "--pre-start", "-t", table(tmp_path, text))
    assert finished.returncode != 0
    assert f"table.yaml:{who}" in finished.stdout + finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_zenoh_gateway_cannot_be_checked_without_zenoh(bare: Environment, tmp_path: Path) -> None:
    zenoh = GATEWAY.replace('websocket: "127.0.0.1:PORT"', "zenoh: {key: rover, config: {scouting: {}}}")
    finished = bare.router(tmp_path, "validate", table(tmp_path, zenoh))
    assert finished.returncode == BAD_TABLE
    assert "a Zenoh gateway needs a Python package that is not installed: zenoh\nhelp: run " in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_table_that_needs_none_runs_without_them(bare: Environment, tmp_path: Path) -> None:
    name = table(tmp_path, UDP)
    assert bare.router(tmp_path, "validate", name).returncode == 0
    assert bare.router(tmp_path, "doctor", "--pre-start", "-t", name).returncode == 0
    (tmp_path / "table.test.yaml").write_text(
        "tests:\n  ph:\n    given: {case: ph_info, from: sensor_board, fields: {ph_value: 7}}\n"
        "    expect: {sent: {basestation: unchanged}}\n"
    )
    finished = bare.router(tmp_path, "test", name)
    assert finished.returncode == 0, finished.stdout + finished.stderr


def test_a_running_router_keeps_its_table_if_the_new_one_needs_a_missing_extra(
    bare: Environment, tmp_path: Path
) -> None:
    path = tmp_path / table(tmp_path, UDP)
    process = subprocess.Popen(
        [bare.python, "-m", "router", "run", "--no-cache", path],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stderr is not None
        log_until_started(process.stderr)
        path.write_text(path.read_text() + GATEWAY.partition("\n")[2].replace("PORT", str(free_port())))
        process.send_signal(signal.SIGHUP)
        reload = next(line for line in process.stderr if '"result"' in line)
        process.terminate()
    assert "a gateway needs Python packages that are not installed: backports.zstd, msgspec" in reload
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("verb", "module", "extra"),
    [
        (("show", "a.mcap"), "mcap", "recording"),
        (("listen", "ws://127.0.0.1:1"), "websockets", "gateways"),
    ],
)
def test_a_verb_that_needs_an_extra_says_which(
    bare: Environment, tmp_path: Path, verb: tuple[str, ...], module: str, extra: str
) -> None:
    finished = bare.router(tmp_path, *verb)
    assert finished.returncode == BAD_TABLE
    assert re.fullmatch(
        f"router {verb[0]}: this needs a Python package that is not installed: .+\nhelp: run .+\n", finished.stderr
    )
    assert extra_of(module) == extra


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_modules_of_an_extra_are_those_of_its_packages(extra: str) -> None:
    [declared] = re.findall(rf"^{extra} = \[(.+?)\]$", (ROOT / "pyproject.toml").read_text(), re.MULTILINE | re.DOTALL)
    packages = {re.sub("[-_.]+", "-", name) for name in re.findall(r'"([\w.-]+)>=', declared)}
    distributions = packages_distributions()
    found = {re.sub("[-_.]+", "-", name) for each in tops([extra]) for name in distributions[each]}
    assert found == packages

"""The router as a ROS package: what it installs, that `ros2 run` would start it, and what the launch file starts.

There are no wheels of ros2 and launch. So what `ros2 run` starts is started here, the launch file meets stand-ins for
launch's classes, and the command that they would make of its arguments is run.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from router import __version__
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.tables import PROTOS, ship

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "deploy" / "ros" / "rover_router"
PATIENCE = 120.0

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
node: {{name: of_the_table}}
listen:
  rover: {{address: "127.0.0.1:${{LISTEN_PORT:-{port}}}"}}
endpoints:
  basestation: {{address: "127.0.0.1:{destination}", kind: basestation}}
routes:
  ph_info: {{source: any, destinations: [basestation]}}
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What colcon does with the package, without colcon."""
    folder = tmp_path_factory.mktemp("ros_package")
    prefix = folder / "install"
    roots = os.pathsep.join(filter(None, (sys.prefix, os.environ.get("AMENT_PREFIX_PATH"))))
    variables = {**os.environ, "AMENT_PREFIX_PATH": roots, "CMAKE_PREFIX_PATH": roots}
    for arguments in (
        ["-S", PACKAGE, "-B", folder, f"-DCMAKE_INSTALL_PREFIX={prefix}", f"-DPython3_EXECUTABLE={sys.executable}"],
        ["--build", folder],
        ["--install", folder],
    ):
        command = ["cmake", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, env=variables, timeout=PATIENCE, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return prefix


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(protos=PROTOS, port=free_port(), destination=free_port()))
    return path


def environment(prefix: Path) -> dict[str, str]:
    """As after `. install/setup.sh`; the checkout is not in it."""
    [packages] = prefix.glob("lib/python*/site-packages")
    return {**os.environ, "PYTHONPATH": str(packages)}


def start(prefix: Path, *arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [prefix / "lib" / "rover_router" / "router", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(prefix),
        cwd="/",
    )


def output(process: subprocess.Popen[str]) -> str:
    """Everything that it says until it ends."""
    printed, said = process.communicate(timeout=PATIENCE)
    return printed + said


def started(process: subprocess.Popen[str]) -> dict[str, Any]:
    """What the log says of the start; ends the process then."""
    assert process.stderr
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("{") and (entry := json.loads(line))["event"] == "router started":
            process.terminate()
            output(process)
            assert process.returncode == 0
            return dict(entry)
    raise AssertionError("".join(said))


def test_package_names_itself_and_its_version_as_python_knows_it() -> None:
    package = (PACKAGE / "package.xml").read_text()
    assert f"<version>{__version__}</version>" in package
    assert "<name>rover_router</name>" in package
    assert re.search(r'<maintainer email="[^@"]+@[^@"]+\.\w+">', package)  # or colcon refuses it


def test_colcon_meets_both_packages_and_neither_inside_the_other() -> None:
    """It descends into no package that it has found, and into no hidden folder."""
    ours = set()
    for folder, inner, files in os.walk(ROOT):  # which other tests change meanwhile
        if "package.xml" in files:
            ours.add(Path(folder))
            inner.clear()
        inner[:] = [name for name in inner if name[0] != "." and name not in {"build", "tests"}]
    assert ours == {PACKAGE, ROOT / "schemas" / "comms"}
    assert all("<license>Apache-2.0</license>" in (path / "package.xml").read_text() for path in ours)
    assert not (ROOT / "setup.py").exists()  # colcon would take the repository for a package


def test_executable_may_be_executed_where_it_is_built_too(installed: Path) -> None:
    """`colcon build --symlink-install` installs a link to it."""
    assert os.access(installed.parent / "router", os.X_OK)


def test_the_carrier_is_built_and_installed(installed: Path) -> None:
    script = "from router.library import load; print(load()._name)"
    loaded = subprocess.check_output([sys.executable, "-c", script], env=environment(installed), cwd="/", text=True)
    assert Path(loaded.strip()).is_relative_to(installed)


def test_ament_finds_the_package_and_its_files(installed: Path) -> None:
    assert (installed / "share" / "ament_index" / "resource_index" / "packages" / "rover_router").exists()
    for name in ("launch/rover_router.launch.py", "routes/rover.yaml", "protos/envelope.lock.json"):
        assert (installed / "share" / "rover_router" / name).is_file()
    assert "PYTHONPATH" in (installed / "share" / "rover_router" / "environment" / "pythonpath.sh").read_text()


def test_executable_is_the_command_line_of_the_version_that_was_installed(installed: Path) -> None:
    assert output(start(installed, "--version")) == f"router {__version__}\n"


def test_tables_are_valid_where_they_are_installed(installed: Path, tmp_path: Path) -> None:
    prefix = shutil.copytree(installed, tmp_path / "install")
    ship(prefix / "share" / "rover_router")
    said = output(start(prefix, "validate", prefix / "share" / "rover_router" / "routes"))
    assert re.findall(r"(\w+)\.yaml: ok", said) == ["legacy", "rover", "sim"]


def test_its_examples_can_be_copied(installed: Path, tmp_path: Path) -> None:
    output(start(installed, "init", "--rover", tmp_path / "copy"))
    [assets] = installed.rglob("_assets")
    names = [{path.relative_to(root) for path in root.rglob("*")} for root in (assets, tmp_path / "copy")]
    assert names[0] == names[1] > {Path("routes/rover.yaml"), Path("schemas/comms/package.xml")}


def test_without_a_verb_it_routes_and_takes_parameters_as_nodes_do(installed: Path, table: Path) -> None:
    port = free_port()
    said = started(start(installed, "--ros-args", "-p", f"routes_path:={table}", "-p", f"listen_port:={port}"))
    assert said["table"] == str(table)
    assert said["listening"] == {"rover": f"127.0.0.1:{port}"}


def test_it_forwards_by_what_it_compiled_before(
    installed: Path, table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    arguments = "--ros-args", "-p", f"routes_path:={table}"
    first = start(installed, *arguments)
    wait_until(lambda: any(tmp_path.glob("cache/rover-router/*.program")), "the kept program")
    first.terminate()
    assert "forwarding with the kept program" not in output(first)
    second = start(installed, *arguments)
    assert second.stderr
    assert "forwarding with the kept program" in second.stderr.readline()
    second.terminate()
    output(second)
    assert second.returncode == 0


def test_without_a_table_it_takes_the_installed_one(installed: Path) -> None:
    """Which is spoiled meanwhile, so that nothing is opened at its real addresses."""
    table = installed / "share" / "rover_router" / "routes" / "rover.yaml"
    text = table.read_text()
    table.write_text("nonsense: 1\n")
    try:
        said = output(start(installed, "--ros-args", "-p", "basestation:=127.0.0.1:9000"))
    finally:
        table.write_text(text)
    assert "/share/rover_router/routes/rover.yaml:1:1: error[unknown-key]" in said
    assert "nonsense" in said


# ---- the launch file ----------------------------------------------------------------------------------------------


@dataclass
class Declared:
    name: str
    default_value: str
    description: str


@dataclass
class Configuration:
    name: str

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@dataclass
class Function:
    function: Callable[[dict[str, str]], list[Node]]


@dataclass
class Description:
    entities: Sequence[Declared | Function]


@dataclass
class Node:
    """With the arguments of launch_ros.actions.Node and of what it derives from, and no others."""

    package: str
    executable: str
    name: str | None = None
    namespace: str | None = None
    parameters: Sequence[str] = ()
    arguments: Sequence[str] = ()
    output: str = "log"
    respawn: bool = False
    respawn_delay: float = 0.0
    remappings: Sequence[tuple[str, str]] = field(default_factory=list)

    def command(self, prefix: Path) -> list[str]:
        """As launch_ros puts it together."""
        words = [str(prefix / "lib" / self.package / self.executable), *self.arguments, "--ros-args"]
        words += ["-r", f"__node:={self.name}"] if self.name is not None else []
        words += ["-r", f"__ns:={self.namespace}"] if self.namespace is not None else []
        return words + [word for file in self.parameters for word in ("--params-file", file)]


@pytest.fixture
def launched(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Node]:
    """The node that the installed launch file makes of launch arguments."""

    def module(name: str, **members: object) -> None:
        made = ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)

    module("launch", LaunchContext=dict, LaunchDescription=Description)
    module("launch.actions", DeclareLaunchArgument=Declared, OpaqueFunction=Function)
    module("launch.substitutions", LaunchConfiguration=Configuration)
    module("launch_ros")
    module("launch_ros.actions", Node=Node)
    module("ament_index_python.packages", get_package_share_directory=lambda name: str(installed / "share" / name))
    file = runpy.run_path(str(installed / "share" / "rover_router" / "launch" / "rover_router.launch.py"))

    def launch(**arguments: str) -> Node:
        *declared, last = file["generate_launch_description"]().entities
        defaults = {each.name: each.default_value for each in declared}
        assert arguments.keys() <= defaults.keys()
        assert all(each.description for each in declared)
        [node] = last.function({**defaults, **arguments})
        assert isinstance(node, Node)
        return node

    return launch


def test_launch_starts_the_installed_table_when_nothing_is_said(installed: Path, launched: Callable[..., Node]) -> None:
    node = launched()
    table = installed / "share" / "rover_router" / "routes" / "rover.yaml"
    assert node.command(installed)[1:] == ["run", str(table), "--log-level", "info", "--ros-args"]
    assert node.output == "screen"
    assert not node.respawn


def test_router_runs_with_all_that_launch_passes_to_it(
    installed: Path, launched: Callable[..., Node], table: Path, tmp_path: Path
) -> None:
    port = free_port()
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text(f"/**: {{ros__parameters: {{listen_port: {port}}}}}\n")
    node = launched(table=str(table), name="other", namespace="/rover", params_file=str(parameters), respawn="true")
    assert node.respawn
    program, *arguments = node.command(installed)
    assert program == str(installed / "lib" / "rover_router" / "router")
    assert started(start(installed, *arguments))["listening"] == {"rover": f"127.0.0.1:{port}"}

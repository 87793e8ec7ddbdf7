"""The router from a wheel, in a folder that has nothing: what comes with it, and that nothing is written to it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import router.assets
from router.ros.environment import ros_package_remedy, ros_remedy
from tests import tables

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0

PROTO = """\
syntax = "proto3";
message Motor {
  float rpm = 1;
}
message PBEnvelope {
  oneof payload {
    Motor motor = 1;
  }
}
"""
TABLE = """\
version: 1
envelope: {message: PBEnvelope, oneof: payload}
listen: {rover: {address: "127.0.0.1:29999"}}
endpoints: {driving_board: {address: "127.0.0.30:8", kind: board}}
routes:
  motor:
    source: driving_board
    topics:
      - {topic: a, type: absent_msgs/msg/A, fields: {x: rpm}}
      - {topic: b, type: absent_msgs/msg/B, fields: {x: rpm}}
"""

Router = Callable[..., "subprocess.CompletedProcess[str]"]


def building(folder: Path, checkout: Path = ROOT, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    environment = {**os.environ, **variables}
    return subprocess.run(
        command, cwd=checkout, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
    )


def build(folder: Path, checkout: Path = ROOT, **variables: str) -> Path:
    built = building(folder, checkout, **variables)
    assert built.returncode == 0, built.stderr
    [path] = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def packages(wheel: Path, tmp_path: Path) -> Path:
    """Where pip would unpack it."""
    folder = tmp_path / "venv" / "site-packages"
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


@pytest.fixture
def routed(packages: Path, tmp_path: Path) -> Router:
    """Runs a verb of the wheel's router in an empty folder."""
    here = tmp_path / "here"
    here.mkdir()

    def run(*arguments: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "router", *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": str(packages), "PYTHONDONTWRITEBYTECODE": "1", **variables}
        return subprocess.run(
            command, cwd=here, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
        )

    return run


def contents(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def ship(packages: Path, proto: str) -> Path:
    """Puts one proto of the test's own into the wheel, in place of those that a team edits, and without a lock."""
    shipped = packages / "router" / "_assets" / "protos"
    shutil.rmtree(shipped)
    shipped.mkdir()
    (shipped / "envelope.proto").write_text(proto)
    return shipped


def loaded(packages: Path) -> str:
    """The carrier's library in an installation, or why there is none."""
    script = """
from router.library import load
from router.errors import StartError
try: print(load())
except StartError as error: print(error)"""
    environment = {**os.environ, "PYTHONPATH": str(packages)}
    return subprocess.check_output([sys.executable, "-c", script], env=environment, cwd=packages, text=True)


def test_the_carrier_comes_with_it_for_this_platform_and_any_python(wheel: Path, packages: Path) -> None:
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    assert wheel.name.endswith(f"-py3-none-{platform}.whl")
    assert f"CDLL '{packages / 'router/carrier/native/libcarrier.so'}'" in loaded(packages)


def test_the_licence_comes_with_it(packages: Path) -> None:
    [metadata] = packages.glob("rover_router-*.dist-info")
    assert "\nLicense-Expression: Apache-2.0\n" in (metadata / "METADATA").read_text()
    for name in ("LICENSE", "NOTICE"):
        assert (metadata / "licenses" / name).read_bytes() == (ROOT / name).read_bytes()


def test_without_a_compiler_it_is_for_any_platform_and_says_what_it_lacks(tmp_path: Path) -> None:
    wheel = build(tmp_path, CC="no-compiler")
    assert wheel.name.endswith("-py3-none-any.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path / "packages")
    said = loaded(tmp_path / "packages")
    assert "was not built, and nothing runs without it; reinstall the router on a machine with a C compiler" in said


def test_the_sdist_makes_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "--target", "sdist", "--directory", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=PATIENCE)
    [sdist] = tmp_path.glob("*.tar.gz")
    shutil.unpack_archive(sdist, tmp_path)
    made = build(tmp_path / "dist", tmp_path / sdist.name.removesuffix(".tar.gz"))
    assert made.name == wheel.name
    files, expected = (zipfile.ZipFile(path) for path in (made, wheel))
    assert files.namelist() == expected.namelist()
    assert [name for name in files.namelist() if files.read(name) != expected.read(name)] == []


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    """A checkout whose tables name protos of somebody else, with the lock beside them."""
    checkout = tmp_path / "checkout"
    ignored = shutil.ignore_patterns("_assets", "__pycache__", "libcarrier.so", "declared.py")
    for name in ("router", "schemas"):
        shutil.copytree(ROOT / name, checkout / name, ignore=ignored)
    for name in ("pyproject.toml", "hatch_build.py", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, checkout / name)
    shutil.copytree(tables.ROUTES, checkout / "routes")
    shutil.copytree(tables.PROTOS, checkout / "upstream")
    (checkout / "upstream" / "LICENSE.md").write_text("theirs")
    (checkout / "upstream" / "firmware.c").write_text("not for the router")
    (checkout / "upstream" / "envelope.lock.json").rename(checkout / "wire.lock.json")
    for table in (checkout / "routes").glob("*.yaml"):
        text = table.read_text().replace("protos: ../protos", "protos: ../upstream\n  lock: ../wire.lock.json")
        table.write_text(text)
    return checkout


def test_protos_are_those_that_the_tables_name(moved: Path, tmp_path: Path) -> None:
    packages = tmp_path / "packages"
    zipfile.ZipFile(build(tmp_path, moved, CC="no-compiler")).extractall(packages)
    assets, there = packages / "router" / "_assets", moved / "upstream"
    assert {path.name for path in assets.iterdir()} == {"routes", "schemas", "upstream", "wire.lock.json"}
    shipped = contents(assets / "upstream")
    assert shipped == {path: text for path, text in contents(there).items() if path.suffix != ".c"}
    assert shipped[Path("LICENSE.md")] == b"theirs"
    command = [sys.executable, "-m", "router", "init", "--rover", str(tmp_path / "copy")]
    subprocess.run(command, env={**os.environ, "PYTHONPATH": str(packages)}, cwd=tmp_path, check=True, timeout=PATIENCE)
    assert contents(tmp_path / "copy") == contents(assets)


def test_no_wheel_is_built_without_the_protos_of_its_tables(moved: Path, tmp_path: Path) -> None:
    def said() -> str:
        built = building(tmp_path / "dist", moved, CC="no-compiler")
        assert (built.returncode, list(tmp_path.glob("dist/*.whl"))) == (1, [])
        return built.stderr.strip()

    for proto in (moved / "upstream").rglob("*.proto"):
        proto.unlink()
    assert said().endswith("if that is a submodule, run `git submodule update --init`")
    shutil.rmtree(moved / "upstream")
    assert said().endswith("names ../upstream, which is not there")
    outside = moved / "routes" / "rover.yaml"
    outside.write_text(outside.read_text().replace("../upstream", "../../upstream"))
    for other in (moved / "routes").glob("*.yaml"):
        if other != outside:
            other.unlink()
    assert "routes/rover.yaml names ../../upstream, which is outside of this checkout" in said()


def test_the_examples_are_copied_and_work_where_they_are(routed: Router, packages: Path, tmp_path: Path) -> None:
    tables.ship(packages / "router" / "_assets")
    assert "write a first one: `router init DIR`" in routed("validate").stderr
    assert routed("init", "--rover", ".").returncode == 0
    copied = tmp_path / "here"
    assert contents(copied) == contents(packages / "router" / "_assets")
    for name in ("routes/sim.yaml", "protos/envelope.lock.json", "schemas/comms/package.xml"):
        assert (copied / name).is_file()
    valid = routed("validate", "routes")
    assert valid.returncode == 0, valid.stdout
    shutil.rmtree(copied / "schemas")
    before = contents(copied)
    again = routed("init", "--rover", ".")
    assert (again.returncode, again.stderr) == (2, "router init: routes already exists; nothing was written\n")
    assert contents(copied) == before


def test_the_lock_of_the_installation_is_not_written(routed: Router, packages: Path, tmp_path: Path) -> None:
    shipped = ship(packages, PROTO)
    before = contents(packages)
    refused = routed("schema", "lock")
    assert (refused.returncode, refused.stderr.splitlines()[0]) == (
        2,
        "router schema: there is no routes/rover.yaml here",
    )
    refused = routed("schema", "lock", "--protos", shipped)
    assert refused.returncode == 2
    assert refused.stderr == (
        f"router schema: {shipped}/envelope.lock.json belongs to the installed router: the next upgrade overwrites "
        "it\nhelp: copy the protos with `router init --rover DIR`, and name the copy: --protos protos\n"
    )
    assert routed("new", "SensorBoardMore", "--number", "99", "--board", "sensor").returncode == 2
    assert contents(packages) == before
    routed("init", "--rover", ".")
    locked = routed("schema", "lock", "--protos", "protos")
    assert "2 new numbers" in locked.stdout, locked.stderr
    assert (tmp_path / "here" / "protos" / "envelope.lock.json").is_file()
    assert contents(packages) == before


def test_the_messages_of_a_sourced_workspace_come_before_those_that_were_shipped(
    packages: Path, tmp_path: Path
) -> None:
    """A team edits and builds its own copy of `comms`."""
    message = tmp_path / "install" / "share" / "comms" / "msg" / "SensorState.msg"
    message.parent.mkdir(parents=True)
    message.write_text("bool ours\n")
    script = "from router.types.ros import ros_interfaces as r; print(r().get('comms/msg/SensorState').fields[0].name)"
    environment = {**os.environ, "PYTHONPATH": str(packages), "AMENT_PREFIX_PATH": str(tmp_path / "install")}
    command = [sys.executable, "-c", script]
    assert subprocess.check_output(command, env=environment, cwd=tmp_path, text=True, timeout=PATIENCE) == "ours\n"


def test_the_doctor_names_a_missing_ros_package_once(routed: Router, packages: Path, tmp_path: Path) -> None:
    """Of a table that names no protos, so that it has those of the wheel."""
    ship(packages, PROTO)
    share = tmp_path / "install" / "share" / "absent_msgs" / "msg"
    share.mkdir(parents=True)
    for name in "AB":
        (share / f"{name}.msg").write_text("float32 x\n")
    (tmp_path / "here" / "table.yaml").write_text(TABLE)
    found = routed("doctor", "-t", "table.yaml", AMENT_PREFIX_PATH=str(tmp_path / "install")).stdout
    [problem, remedy] = [line for line in found.splitlines() if "absent_msgs" in line]
    assert problem.startswith("problem  ROS        absent_msgs/msg/A is not installed")
    assert problem.endswith("(there is no Python package 'absent_msgs.msg'); and 1 more of its types")
    assert remedy.strip() == "-> source the workspace that has the ROS package 'absent_msgs', or install it"


def test_an_installation_is_told_how_to_get_ros_without_make(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "'make setup'" in ros_remedy()
    assert "'make setup'" in ros_package_remedy("comms")
    monkeypatch.setattr(router.assets, "_PACKAGE", ROOT)  # what is in the checkout is installed then
    assert ros_remedy() == ("run `pip install 'rover-router[ros]'`, or source the setup.sh of an installed ROS 2 Jazzy")
    assert ros_package_remedy("comms") == (
        "source the workspace that has the ROS package 'comms', or build it in an activated environment: "
        "`router init --rover . && export AMENT_PREFIX_PATH=$VIRTUAL_ENV && "
        "colcon build --base-paths schemas/comms && . install/setup.sh`"
    )

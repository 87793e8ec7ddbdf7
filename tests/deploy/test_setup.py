"""deploy/setup.sh: which steps it takes, what it remembers, and what it leaves to be sourced.

pip, cmake and the C compiler are stand-ins that only note how they were called: what the steps make is tested by
everything else in tests/, which runs in an environment that it has made. The scripts of the installed ROS are ament's.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import cache_from_source
from pathlib import Path

import pytest

from tests.compiler.interface_package import environment, is_buildable

ROOT = Path(__file__).parents[2]
ONLY_NEEDED = "deploy/interfaces.cmake"
PATIENCE = 120.0

NOTE = 'printf "%s\\n" "$(basename "$0") $*" >> "$CALLS"\n'
CMAKE = f"""#!/bin/sh
set -e
{NOTE}case $1 in
  -S) mkdir -p "$4" ;;
  --build) ! [ -e "$INTERFACES/broken" ] ;;
  --install)
    mkdir -p .venv/share/comms
    cp -r "$INTERFACES"/* .venv/share/comms
    find "$PWD/.venv/share/comms" -type f > "$2/install_manifest.txt" ;;
esac
"""
CC = f"""#!/bin/sh
{NOTE}all="$*"
while [ "$1" != -o ]; do shift; done
echo "$all" > "$2"  # with the checksum, as the library
"""
PYTHON = f"""#!/bin/sh
[ "$1 $2" != "-m venv" ] || {{ shift 2; set -- -m venv --without-pip "$@"; }}  # without, it is ten times as fast
exec {sys.executable} "$@"
"""
PIP = """\
import os, pathlib, sys
print("pip", *sys.argv[1:], file=open(os.environ["CALLS"], "a"))
if "[ros" in sys.argv[-1]:
    headers = pathlib.Path(sys.prefix, "include", "rcl", "rcl")
    headers.mkdir(parents=True, exist_ok=True)
    (headers / "types.h").touch()
"""
RCL = Path("include", "rcl", "rcl", "types.h")


def script(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def ament(template: str, prefix: Path, **filled: str) -> str:
    """A script of ament's, as a build fills it in."""
    templates = pytest.importorskip("ament_package.templates")
    level, name = template.split("/")
    text: str = Path(getattr(templates, f"get_{level}_template_path")(name)).read_text()
    for key, value in {"CMAKE_INSTALL_PREFIX": str(prefix), "SKIP_PARENT_PREFIX_PATH": "1", **filled}.items():
        text = text.replace(f"@{key}@", value)
    return text


class Checkout:
    """What setup.sh reads of this checkout, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "router"
        self.ros = folder / "jazzy"
        self.interfaces = folder / "comms"
        self._stubs = folder / "stubs"
        self._calls = folder / "calls"
        building = "router/carrier/build.py", "router/carrier/headers.py"
        for file in ("pyproject.toml", "constraints.txt", "deploy/setup.sh", ONLY_NEEDED, *building):
            (self.root / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, self.root / file)
        shutil.copytree(ROOT / "schemas" / "comms", self.root / "schemas" / "comms")
        (self.root / "router" / "carrier" / "native").mkdir()
        script(self._stubs / "python", PYTHON)
        script(self._stubs / "cmake", CMAKE)
        script(self._stubs / "cc", CC)
        script(self._stubs / "pip" / "__init__.py", "")
        script(self._stubs / "pip" / "__main__.py", PIP)
        self._prepare_interfaces(self.interfaces)
        self._install_ros()

    def _prepare_interfaces(self, share: Path) -> None:
        """What building the interfaces leaves to be sourced."""
        hook = 'ament_append_value AMENT_ENVIRONMENT_HOOKS "$AMENT_CURRENT_PREFIX/share/comms/prefix.sh"'
        text = ament("package_level/local_setup.sh.in", self.root / ".venv", ENVIRONMENT_HOOKS=hook)
        script(share / "local_setup.sh", text)
        script(share / "prefix.sh", ament("environment_hook/ament_prefix_path.sh", self.root / ".venv"))

    def _install_ros(self) -> None:
        """What setup.sh needs of an installed Jazzy."""
        for folder in (f"lib/python3.{sys.version_info[1]}", "share/rclpy", "share/rosidl_default_generators"):
            (self.ros / folder).mkdir(parents=True)
        (self.ros / RCL).parent.mkdir(parents=True)
        (self.ros / RCL).touch()
        filled = {"ament_package_PYTHON_EXECUTABLE": sys.executable}
        script(self.ros / "setup.sh", ament("prefix_level/setup.sh.in", self.ros))
        script(self.ros / "local_setup.sh", ament("prefix_level/local_setup.sh.in", self.ros, **filled))
        script(self.ros / "_local_setup_util.py", ament("prefix_level/_local_setup_util.py", self.ros))
        script(self.ros / "setup.bash", ". $(dirname ${BASH_SOURCE[0]})/setup.sh\n")

    def set_up(self, *, fails: bool = False, **variables: str) -> list[str]:
        """Run setup.sh; return what it printed and the programs that it called, with their arguments."""
        self._calls.write_text("")
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("AMENT_", "ROS"))},
            "PATH": f"{self._stubs}:{os.environ['PATH']}",
            "PYTHONPATH": str(self._stubs),
            "PYTHON": str(self._stubs / "python"),
            "CALLS": str(self._calls),
            "INTERFACES": str(self.interfaces),
            **variables,
        }
        done = subprocess.run(
            [self.root / "deploy" / "setup.sh"],
            env=environment,
            cwd=self.root,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        assert (done.returncode != 0) == fails, done.stdout + done.stderr
        return [*done.stdout.splitlines(), *self._calls.read_text().splitlines()]

    def installed(self, said: Sequence[str]) -> str:
        """The extras of the package that were installed, from what `set_up` returns."""
        [pip] = [line for line in said if line.startswith("pip")]
        return pip.removeprefix(f"pip install --no-input --editable {self.root}")

    def files(self) -> dict[Path, int]:
        """All of the checkout, with the times of their last changes."""
        return {path: path.lstat().st_mtime_ns for path in self.root.rglob("*")}

    def sourced(self, name: str) -> str:
        """The environment variable in a shell that has sourced env.sh, and nothing before."""
        command = ["sh", "-c", f'. .venv/env.sh; printf %s "${name}"']
        return subprocess.check_output(command, env={"PATH": os.environ["PATH"]}, cwd=self.root, text=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_interfaces_are_found_beside_an_installed_ros(checkout: Checkout) -> None:
    """ROS's setup.sh leaves a variable that the interfaces' script takes for where they are."""
    checkout.set_up(ROS=str(checkout.ros))
    assert checkout.sourced("AMENT_PREFIX_PATH").split(":")[0] == f"{checkout.root}/.venv"


def test_carrier_is_compared_with_an_installed_ros(checkout: Checkout) -> None:
    said = checkout.set_up(ROS=str(checkout.ros))
    [compiled] = [line for line in said if line.startswith("cc")]
    assert f"-isystem{checkout.ros}/include/rcl" in compiled.split()
    (checkout.ros / RCL).unlink()
    (checkout.root / "router" / "carrier" / "native" / "changed.c").touch()
    assert "setup: carrier ... failed" in checkout.set_up(fails=True)


def test_second_run_calls_nothing_and_changes_nothing(checkout: Checkout) -> None:
    checkout.set_up(ROS=str(checkout.ros))
    before = checkout.files()
    assert checkout.set_up() == ["setup: .venv is up to date"]
    assert checkout.files() == before


def test_modules_are_compiled_for_a_service_that_may_not_write(checkout: Checkout) -> None:
    module = checkout.root / "router" / "carrier" / "build.py"
    compiled = Path(cache_from_source(str(module)))
    checkout.set_up(ROS=str(checkout.ros))
    before = compiled.stat().st_mtime_ns
    module.write_text(module.read_text() + "\n")
    os.utime(module, ns=(before, before + 2 * 10**9))  # a compiled module knows seconds
    checkout.set_up()
    assert compiled.stat().st_mtime_ns > before


def test_interfaces_are_built_again_after_a_change_of_how(checkout: Checkout) -> None:
    checkout.set_up(ROS=str(checkout.ros))
    with (checkout.root / ONLY_NEEDED).open("a") as file:
        file.write("# changed\n")
    said = checkout.set_up()
    assert [line.split()[0] for line in said[1:]] == ["cmake"] * 3
    assert f"-DCMAKE_PROJECT_comms_INCLUDE={checkout.root / ONLY_NEEDED}" in said[1].split()


def test_interfaces_that_are_no_more_go_when_the_new_ones_are_built(checkout: Checkout) -> None:
    message, built = checkout.root / "schemas" / "comms" / "msg" / "Gone.msg", checkout.root / ".venv/share/comms/Gone"
    broken = checkout.interfaces / "broken"
    message.write_text("")
    (checkout.interfaces / "Gone").write_text("")
    checkout.set_up()
    message.unlink()
    (checkout.interfaces / "Gone").unlink()
    broken.write_text("")
    checkout.set_up(fails=True)
    assert built.exists()  # a service that starts meanwhile finds all it had
    broken.unlink()
    checkout.set_up()
    assert not built.exists()
    assert built.with_name("local_setup.sh").exists()


def test_interfaces_that_colcon_ignores_are_neither_built_nor_kept(checkout: Checkout) -> None:
    ignored, built = checkout.root / "schemas/comms/COLCON_IGNORE", checkout.root / ".venv/share/comms/local_setup.sh"
    checkout.set_up(ROS=str(checkout.ros))
    assert built.exists()
    ignored.touch()
    assert checkout.set_up()[1:] == []
    assert not built.exists()
    assert "/.venv" not in checkout.sourced("AMENT_PREFIX_PATH")
    assert checkout.set_up() == ["setup: .venv is up to date"]
    ignored.unlink()
    checkout.set_up()
    assert built.exists()


@pytest.mark.parametrize(("apt", "ros"), [(False, "ros,"), (True, "")])
def test_tools_for_developers_can_be_left_out(checkout: Checkout, apt: bool, ros: str) -> None:
    without = f"{ros}gateways,foxglove,recording"
    assert checkout.installed(checkout.set_up(DEV="no", ROS=str(checkout.ros) if apt else "")) == f"[{without}]"
    assert checkout.set_up() == ["setup: .venv is up to date"]  # it is remembered
    assert checkout.installed(checkout.set_up(DEV="yes")) == f"[{without},dev]"


def test_make_says_how_to_get_the_tools_that_tests_need(checkout: Checkout) -> None:
    shutil.copy(ROOT / "Makefile", checkout.root)
    (checkout.root / "deploy" / "setup.sh").write_text("#!/bin/sh\n")
    command = [str(shutil.which("make")), "test"]
    done = subprocess.run(command, cwd=checkout.root, capture_output=True, text=True, check=False)
    assert done.stderr.startswith("make: tools for developers are missing: run 'make setup DEV=yes'\n")
    assert done.returncode


@pytest.mark.slow
@pytest.mark.skipif(not is_buildable(), reason="ROS's generators or cmake are not installed")
@pytest.mark.parametrize("options", [(), (f"-DCMAKE_PROJECT_comms_INCLUDE={ROOT / ONLY_NEEDED}",)])
def test_only_a_workspace_builds_the_interfaces_for_cpp(options: Sequence[str], tmp_path: Path) -> None:
    source, build = str(ROOT / "schemas" / "comms"), str(tmp_path)
    command = ["cmake", "-S", source, "-B", build, f"-DPython3_EXECUTABLE={sys.executable}"]
    listing = ["cmake", "--build", build, "--target", "help"]
    subprocess.run([*command, *options], env=environment(), capture_output=True, timeout=PATIENCE, check=True)
    targets = subprocess.check_output(listing, text=True, timeout=PATIENCE)
    made = set(re.findall(r"comms__rosidl_(\w+)$", targets, re.MULTILINE))
    assert any(name.endswith("_cpp") for name in made) == (not options)
    assert made > {
        "generator_py",
        "typesupport_fastrtps_c",
        "typesupport_introspection_c",
    }  # for Fast DDS, for other middlewares

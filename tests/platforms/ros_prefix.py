"""Builds /opt/ros/jazzy with the layout of Ubuntu's packages from the wheels in pyproject.toml.

python3 tests/platforms/ros_prefix.py [PREFIX]

`apt.sh` runs it with the distribution's Python 3.12, which has ROS's dependencies from Debian packages. There are no
wheels of launch and ros2cli. ament's templates generate the set-up scripts; the hooks of ros_environment, which has no
wheel either, are equivalent to the real ones.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution
from pathlib import Path

ROOT = Path(__file__).parents[2]
VARIABLES = """\
set;ROS_VERSION;2
set;ROS_PYTHON_VERSION;3
set;ROS_DISTRO;jazzy
set-if-unset;ROS_AUTOMATIC_DISCOVERY_RANGE;SUBNET
"""
WHEELS_ONLY = ("ros_wheels_bootstrapper", "ros_wheels_bootstrapper.pth")
VENV_ONLY = ("pyvenv.cfg", "lib64", "bin/activate*", "bin/Activate.ps1", "bin/python*")


def requirements() -> list[str]:
    """The ROS packages without the wheels' other dependencies, which Ubuntu has as Debian packages."""
    return re.findall(r'"(ros-jazzy-[^"]*)"', (ROOT / "pyproject.toml").read_text())


def make(prefix: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", prefix], check=True)
    pip = [f"{prefix}/bin/python", "-m", "pip", "install", "--quiet", "--no-compile"]
    subprocess.run([*pip, "--constraint", f"{ROOT}/constraints.txt", *requirements()], check=True)
    [packages] = prefix.glob("lib/python3*/site-packages")
    leave_only_ros(packages)
    for library in packages.glob("ros_*.libs/*"):
        library.replace(prefix / "lib" / library.name)
    remove(path for pattern in ("ros_*.libs", *WHEELS_ONLY) for path in packages.glob(pattern))
    remove(path for pattern in VENV_ONLY for path in prefix.glob(pattern))
    take_shebangs_from_the_system(prefix)
    write_setup(prefix, packages)
    register_variables(prefix)


def leave_only_ros(packages: Path) -> None:
    """Remove all other packages and all of pip's metadata."""
    for metadata in list(packages.glob("*.dist-info")):
        if not metadata.name.startswith("ros_"):
            distribution = Distribution.at(metadata)
            remove(Path(str(distribution.locate_file(file))) for file in distribution.files or ())
        remove([metadata])
    for folder in sorted(packages.rglob("*/"), reverse=True):
        if not any(folder.iterdir()):
            folder.rmdir()


def remove(paths: Iterable[Path]) -> None:
    for path in list(paths):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def take_shebangs_from_the_system(prefix: Path) -> None:
    for program in (prefix / "bin").iterdir():
        text = program.read_bytes()
        if text.startswith(b"#!" + bytes(prefix)):
            program.write_bytes(re.sub(rb"^#!.*", b"#!/usr/bin/python3", text))


def write_setup(prefix: Path, packages: Path) -> None:
    """Write the set-up scripts, as ament_generate_environment() does in ros_workspace."""
    filled = {
        "CMAKE_INSTALL_PREFIX": str(prefix),
        "SKIP_PARENT_PREFIX_PATH": "1",
        "ament_package_PYTHON_EXECUTABLE": "/usr/bin/python3",
    }
    for template in (packages / "ament_package" / "template" / "prefix_level").iterdir():
        if template.suffix in {".in", ".bash", ".zsh"} or template.name == "_local_setup_util.py":
            text = re.sub(r"@(\w+)@", lambda found: filled[found[1]], template.read_text())
            (prefix / template.name.removesuffix(".in")).write_text(text)


def register_variables(prefix: Path) -> None:
    share, index = prefix / "share" / "ros_environment", prefix / "share" / "ament_index" / "resource_index"
    share.mkdir()
    (share / "package.dsv").write_text("source;share/ros_environment/local_setup.dsv\n")
    (share / "local_setup.dsv").write_text(VARIABLES)
    (index / "packages" / share.name).touch()
    (index / "package_run_dependencies" / share.name).touch()


if __name__ == "__main__":
    make(Path(sys.argv[1] if len(sys.argv) > 1 else "/opt/ros/jazzy"))

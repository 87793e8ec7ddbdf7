"""A ROS interface package of unusual messages, built for the tests and cached beside the environment.

Only another process can load it, because the loader of this one has already read its search path.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from router.types.model import MessageType
from router.types.ros import MsgFiles, RosbagsDefinitions, RosInterfaces

ROOT = Path(__file__).parents[2]
NAME = "nasty"
MESSAGES: Mapping[str, str] = {
    "Empty": "",
    "HoldsEmpty": "Empty empty\nuint8 after\nEmpty[] many\nEmpty[2] two\nEmpty[<=3] few\nint64 wide",
    "Inner": "string name\nfloat64 value",
    "Text": (
        "string text\nfloat64 after\nstring[] many\nstring[2] two\nstring<=5 brief\nstring<=5[<=2] both\nuint8 last"
    ),
    "WideText": (
        "uint8 first\nwstring text\nfloat64 after\nwstring[] many\nwstring[2] two\nwstring<=5 brief\n"
        "wstring<=5[<=2] both\nuint8 last"
    ),
    "Small": "bool yes\nint8 little\nuint8 large\nbyte octet\nchar letter\nint16 middle\nuint64 huge\nbyte last",
    "SmallArrays": (
        "bool[3] yes\nint8[2] little\nbyte[] octets\nchar[<=4] letters\nuint16 gap\nbool[] flags\nbyte[3] three\n"
        "int8[<=3] few\nuint32 last"
    ),
    "Numbers": (
        "uint8 first\nfloat64[] doubles\nuint8 second\nfloat64 after\nfloat32[] floats\nint64[<=2] few\nuint8 third\n"
        "uint64[2] two\nint16[] shorts\nuint32[3] three\nint64[] none\nuint16[<=5] words\nfloat32 last"
    ),
    "Repeated": "Inner[] many\nuint8 gap\nInner[2] two\nInner[<=3] few\nInner one\nHoldsEmpty[] holders\nuint8 last",
    "Deep": "Repeated[] all\nSmallArrays[2] arrays\nRepeated one\nNumbers[<=2] numbers\nuint8 last",
    "Defaults": (
        "uint8 mapped\nint32 answer 42\nint64 low -9223372036854775808\nfloat32 half 0.5\nbool yes true\n"
        "string text 'it is'\nstring<=5 brief \"five5\"\nint16[3] three [1, -2, 3]\nfloat64[] some [1.5, 2.5]\n"
        "string[] words ['a', 'b c']\nbool[2] flags [true, false]\nbyte octet 255\n"
        "wstring wide 'wide'\nDefaultsInside inside"
    ),
    "DefaultsInside": "uint16 number 7\nstring text 'inside'\nfloat64 zero",
}
_PACKAGE = f"""<package format="3">
  <name>{NAME}</name> <version>0.0.0</version> <description>For tests.</description>
  <maintainer email="nobody@example.org">nobody</maintainer> <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""
_CMAKE = f"""
cmake_minimum_required(VERSION 3.12)
project({NAME})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
file(GLOB messages RELATIVE ${{CMAKE_CURRENT_SOURCE_DIR}} msg/*.msg)
rosidl_generate_interfaces(${{PROJECT_NAME}} ${{messages}})
ament_package()
"""
_ONLY_NEEDED = ROOT / "deploy" / "interfaces.cmake"


class InterfacePackage:
    """The built package, and a process that has loaded its types."""

    def __init__(self, install: Path) -> None:
        self.share = install / "share"
        program = Path(__file__).with_name("ros_objects.py")
        self._process = subprocess.Popen(
            [sys.executable, str(program)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(install),
        )  # fmt: skip

    def ask(self, name: str, value: object, data: bytes) -> tuple[bytes, dict[str, Any]]:
        """rclpy's serialization of a value, and the value that rclpy reads from our bytes."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([f"{NAME}/msg/{name}", value, data.hex()]) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        return bytes.fromhex(answer["data"]), answer["value"]

    def close(self) -> None:
        self._process.communicate(timeout=30)


def is_buildable() -> bool:
    return shutil.which("cmake") is not None and any(
        (prefix / "share/rosidl_generator_py").is_dir() for prefix in _prefixes()
    )


def built() -> Path:
    """The installation. The first build of these messages takes about 15 s."""
    made_from = f"{sys.version}{MESSAGES}{_PACKAGE}{_CMAKE}{_ONLY_NEEDED.read_text()}"
    key = hashlib.sha256(made_from.encode()).hexdigest()[:12]
    folder = Path(sys.prefix, "build", f"{NAME}-{key}")
    folder.mkdir(parents=True, exist_ok=True)
    done = folder / "done"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            _build(folder)
            done.touch()
    return folder / "install"


def write_sources(folder: Path) -> None:
    (folder / "msg").mkdir(parents=True, exist_ok=True)
    (folder / "package.xml").write_text(_PACKAGE)
    (folder / "CMakeLists.txt").write_text(_CMAKE)
    for name, text in MESSAGES.items():
        (folder / "msg" / f"{name}.msg").write_text(text + "\n")


def _build(folder: Path) -> None:
    source = folder / "source"
    write_sources(source)
    options = ["-DCMAKE_BUILD_TYPE=Debug", f"-DCMAKE_INSTALL_PREFIX={folder}/install", "-DBUILD_TESTING=OFF",
               f"-DPython3_EXECUTABLE={sys.executable}", f"-DCMAKE_PROJECT_{NAME}_INCLUDE={_ONLY_NEEDED}"]  # fmt: skip
    commands = [
        ["cmake", "-S", str(source), "-B", str(folder / "build"), *options],
        ["cmake", "--build", str(folder / "build"), "--parallel", str(os.cpu_count())],
        ["cmake", "--install", str(folder / "build")],
    ]
    for command in commands:
        ran = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
        assert ran.returncode == 0, f"{' '.join(command)}:\n{ran.stdout[-4000:]}\n{ran.stderr[-4000:]}"


def _prefixes() -> list[Path]:
    named = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    return [*map(Path, named), Path(sys.prefix)]


def environment(*installs: Path) -> dict[str, str]:
    """The variables that a ROS set-up script would set, for wheels and for an installed ROS."""
    prefixes = [*installs, *_prefixes()]
    site_packages = f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    libraries = [prefix / "lib" for prefix in prefixes]
    libraries += Path(sys.prefix, site_packages).glob("ros_*.libs")
    added = {
        "AMENT_PREFIX_PATH": prefixes,
        "CMAKE_PREFIX_PATH": prefixes,
        "LD_LIBRARY_PATH": libraries,
        "PYTHONPATH": [install / site_packages for install in installs],
    }
    return os.environ | {
        name: os.pathsep.join([*map(str, paths), os.environ.get(name, "")]).rstrip(os.pathsep)
        for name, paths in added.items()
    }


def declared_type(package: InterfacePackage, name: str) -> MessageType:
    found = RosInterfaces(MsgFiles([package.share]), RosbagsDefinitions()).get(f"{NAME}/msg/{name}")
    assert found is not None
    return found

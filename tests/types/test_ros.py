"""ROS message types: against the installed Python classes, and from sources of the test's own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from router.errors import Code, SourceSpan, TableError
from router.types.model import Float, Int, List, MessageType
from router.types.ros import (
    DEFAULTS_MISSING_IN_ROSBAGS,
    MsgFiles,
    RosbagsDefinitions,
    RosInterfaces,
    definition,
    msg_files,
    ros_interfaces,
)
from tests.types.conftest import Write

Interfaces = Callable[[Mapping[str, str]], RosInterfaces]

INSTALLED = sorted(set(msg_files().names()))


@pytest.fixture(scope="module")
def installed() -> RosInterfaces:
    return ros_interfaces()


@pytest.fixture(scope="module")
def carried() -> RosInterfaces:
    """As on a machine without ROS: what rosbags carries, nothing else."""
    return RosInterfaces(MsgFiles([]), RosbagsDefinitions())


@pytest.fixture
def interfaces(write: Write) -> Interfaces:
    """Of `.msg` files that the test writes."""
    return lambda files: RosInterfaces(MsgFiles([write(files)]), RosbagsDefinitions())


def python_class(name: str) -> Any:
    """The installed class of a message type."""
    package, _, short = name.split("/")
    return getattr(pytest.importorskip(f"{package}.msg", reason="its Python package is not installed"), short)


def typed(message: MessageType) -> list[tuple[str, str, object]]:
    return [(field.name, str(field.type), field.default) for field in message.fields]


@pytest.mark.parametrize("package", sorted({name.partition("/")[0] for name in INSTALLED}))
def test_definitions_are_those_of_the_installed_classes(installed: RosInterfaces, package: str) -> None:
    """Spelled as rclpy does, with the same default values and constants."""
    for name in [name for name in INSTALLED if name.startswith(f"{package}/")]:
        message, theirs = installed.get(name), python_class(name)
        assert message is not None
        assert dict(definition(message)) == theirs.get_fields_and_field_types(), name
        default = theirs()
        for field in message.fields:
            if field.default is not None:
                assert getattr(default, field.name) == field.default, name
            elif isinstance(field.type, Int | Float) and not (isinstance(field.type, Int) and field.type.octet):
                assert getattr(default, field.name) == 0, name
        for constant, value in message.constants.items():
            found = getattr(theirs, constant)
            assert (found[0] if isinstance(found, bytes) else found) == value, name


def test_rosbags_says_the_same_as_the_installed_packages(installed: RosInterfaces, carried: RosInterfaces) -> None:
    both = [name for name in INSTALLED if carried.get(name) is not None]
    if not both:
        pytest.skip("no ROS on this machine")
    for name in both:
        ours, theirs = installed.get(name), carried.get(name)
        assert ours is not None
        assert theirs is not None
        assert definition(ours) == definition(theirs)
        assert typed(ours) == typed(theirs)
        assert ours.constants == theirs.constants
    assert {"sensor_msgs/msg/Imu", *(name for name, _ in DEFAULTS_MISSING_IN_ROSBAGS)} <= set(both)


def test_type_that_is_not_installed_comes_out_of_rosbags(interfaces: Interfaces) -> None:
    odometry = interfaces({}).get("nav_msgs/msg/Odometry")
    assert odometry is not None
    assert dict(definition(odometry)) == {
        "header": "std_msgs/Header",
        "child_frame_id": "string",
        "pose": "geometry_msgs/PoseWithCovariance",
        "twist": "geometry_msgs/TwistWithCovariance",
    }
    orientation = odometry.fields[2].type.fields[0].type.fields[1].type  # type: ignore[union-attr]
    assert [(field.name, field.default) for field in orientation.fields][-1] == ("w", 1.0)  # type: ignore[union-attr]


def test_a_package_that_colcon_ignores_is_ignored(interfaces: Interfaces) -> None:
    ours = {"ours_msgs/msg/A.msg": "bool a\n", "theirs_msgs/msg/A.msg": "bool a\n", "theirs_msgs/COLCON_IGNORE": ""}
    found = interfaces(ours)
    assert found.get("ours_msgs/msg/A") is not None
    assert found.get("theirs_msgs/msg/A") is None
    assert {name for name in found.names() if name.endswith("_msgs/msg/A")} == {"ours_msgs/msg/A"}


def test_rosbags_is_not_imported_for_what_is_installed() -> None:
    script = (
        "import sys\n"
        "from router.types.ros import ros_interfaces\n"
        "assert ros_interfaces().get('comms/msg/SensorBoardDiagnostics') is not None\n"
        "sys.exit(any(name.startswith('rosbags') for name in sys.modules))\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=30)


def test_our_own_folder_comes_before_the_workspaces(
    write: Write, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write({"share/comms/msg/SensorState.msg": "bool other", "share/extra/msg/Thing.msg": "bool x"})
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    found = ros_interfaces()
    state, thing = found.get("comms/msg/SensorState"), found.get("extra/msg/Thing")
    assert state is not None
    assert [field.name for field in state.fields] == ["state"]
    assert thing is not None
    assert "extra/msg/Thing" in found.names()


def test_nested_and_local_names_are_resolved_once(interfaces: Interfaces) -> None:
    found = interfaces(
        {
            "p/msg/Part.msg": "uint8 X=3\nfloat32 x 1.5 # m\n",
            "q/msg/Whole.msg": "p/Part[2] parts\np/Part[<=3] more\np/Part one\nbuiltin_interfaces/Time stamp\n",
        }
    )
    whole, part = found.get("q/msg/Whole"), found.get("p/msg/Part")
    assert whole is not None
    assert part is not None
    assert [field.type for field in whole.fields[:3]] == [List(part, length=2), List(part, bound=3), part]
    assert definition(whole) == (
        ("parts", "p/Part[2]"),
        ("more", "sequence<p/Part, 3>"),
        ("one", "p/Part"),
        ("stamp", "builtin_interfaces/Time"),
    )
    assert (part.constants, part.fields[0].default, part.fields[0].comment) == ({"X": 3}, 1.5, "m")


def test_message_without_fields_has_none(installed: RosInterfaces, carried: RosInterfaces) -> None:
    for source in (installed, carried):
        empty = source.get("std_msgs/msg/Empty")
        assert empty is not None
        assert empty.fields == ()


@pytest.mark.parametrize(
    "name", ["p/msg/Nothing", "Imu", "sensor_msgs/Imu", "../msg/Imu", "sensor_msgs/msg/../Imu", ""]
)
def test_unknown_name_is_none(interfaces: Interfaces, name: str) -> None:
    assert interfaces({"p/msg/Part.msg": ""}).get(name) is None


@pytest.mark.parametrize(
    ("text", "code", "place", "message"),
    [
        ("float32 x\nfloatt y", Code.BAD_FILE, (2, 1, 7), "'floatt' is not a type"),
        ("float32 x\nNothing y", Code.UNKNOWN_ROS_TYPE, (2, 1, 1), "there is no ROS message type 'p/msg/Nothing'"),
        ("A x", Code.BAD_FILE, (1, 1, 1), "p/msg/A contains itself: p/msg/A > p/msg/A"),
        ("\nB x", Code.BAD_FILE, (1, 1, 1), "p/msg/A contains itself: p/msg/A > p/msg/B > p/msg/A"),
    ],
)
def test_broken_definition_is_a_finding_in_the_msg_file(
    interfaces: Interfaces, text: str, code: Code, place: tuple[int, int, int], message: str
) -> None:
    found = interfaces({"p/msg/A.msg": text, "p/msg/B.msg": "A a"})
    with pytest.raises(TableError) as caught:
        found.get("p/msg/A")
    (finding,) = caught.value.diagnostics
    file = "p/msg/B.msg" if "B >" in message else "p/msg/A.msg"
    assert (finding.code, finding.span, finding.message) == (code, SourceSpan(file, *place), message)


def test_file_that_is_no_text_is_a_finding(interfaces: Interfaces, tmp_path: Path) -> None:
    found = interfaces({"p/msg/A.msg": ""})
    (tmp_path / "p/msg/A.msg").write_bytes(b"\xff\xfe")
    with pytest.raises(TableError) as caught:
        found.get("p/msg/A")
    assert [finding.code for finding in caught.value.diagnostics] == [Code.BAD_FILE]

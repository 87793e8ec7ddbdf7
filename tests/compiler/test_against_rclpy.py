"""The bytes that are published equal those of rclpy, and the oracle reads what rclpy has serialized as rclpy does."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given

from router.compiler import Checked
from router.compiler.lookup import Definitions
from router.rehearsal.cdr import deserialize
from router.types.model import MessageType
from tests.compiler.comparing import assert_same_message, same, without_nul
from tests.compiler.compiling import AUTO, context_of, outcome, scope_of, serializer
from tests.compiler.generated_types import EACH_TYPE, mirror, values
from tests.compiler.machine import FAILURES
from tests.compiler.reading import field_values, plain
from tests.oracles.reference import fill

pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message, serialize_message

from tests.compiler.ros_objects import deserialized, message_class, serialized, to_object

OTHERS = [
    "geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/Wrench", "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Joy",
    "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan", "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Range", "sensor_msgs/msg/TimeReference", "std_msgs/msg/Bool", "std_msgs/msg/Byte",
    "std_msgs/msg/ByteMultiArray", "std_msgs/msg/Char", "std_msgs/msg/ColorRGBA", "std_msgs/msg/Empty",
    "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Int64MultiArray", "std_msgs/msg/Int8", "std_msgs/msg/String",
    "std_msgs/msg/UInt8MultiArray", "builtin_interfaces/msg/Duration", "rcl_interfaces/msg/ParameterValue",
]  # fmt: skip


def assert_equal_bytes(declared: MessageType, source: MessageType, message: Any) -> None:
    """`source` is the declared type's mirror, so that `auto` maps all of it."""
    value = outcome(lambda: fill(AUTO, declared, context_of(message, source)))
    ours = outcome(lambda: serializer(AUTO, declared, scope_of(source))(message))
    if value is FAILURES or ours is FAILURES:
        assert value is ours
        return
    assert_same_message(ours, serialized(declared.name, value), declared, value)
    assert same(deserialized(declared.name, ours), value)


def test_types_in_use_are_written_as_rclpy_does(rover: Checked) -> None:
    types = {target.type.name: target.type for route in rover.routes for target in route.targets if target.type}
    assert types
    for declared in types.values():
        assert_written_as_rclpy_does(declared)


@pytest.mark.parametrize("name", OTHERS)
def test_type_is_written_as_rclpy_does(definitions: Definitions, name: str) -> None:
    declared = definitions.interfaces.get(name)
    assert declared is not None
    assert_written_as_rclpy_does(declared)


def assert_written_as_rclpy_does(declared: MessageType) -> None:
    source = mirror(declared)

    @EACH_TYPE
    @given(values(source))
    def equal(message: Any) -> None:
        assert_equal_bytes(declared, source, message)

    equal()


PACKAGES = ("builtin_interfaces", "geometry_msgs", "sensor_msgs", "std_msgs")


def is_installed(package: str, name: str) -> bool:
    home, _, short = name.partition("/msg/")
    return home == package and find_spec(f"{home}.msg") is not None and hasattr(message_package(home), short)


def message_package(name: str) -> ModuleType:
    return import_module(f"{name}.msg")


@pytest.mark.parametrize("package", ["comms", *(pytest.param(each, marks=pytest.mark.slow) for each in PACKAGES)])
def test_types_are_read_as_rclpy_does(definitions: Definitions, package: str) -> None:
    names = [name for name in definitions.interfaces.names() if is_installed(package, name)]
    if not names:
        pytest.skip(f"{package} is not installed")
    for name in sorted(names):
        assert_read_as_rclpy_does(definitions, name)


def assert_read_as_rclpy_does(definitions: Definitions, name: str) -> None:
    declared = definitions.interfaces.get(name)
    assert declared is not None

    @EACH_TYPE
    @given(values(declared))
    def equal(message: object) -> None:
        value = without_nul(field_values(message, declared))
        assert isinstance(value, dict)
        data = bytes(serialize_message(to_object(message_class(name), value)))
        theirs = deserialize_message(data, message_class(name))
        assert same(plain(deserialize(declared, data), declared), plain(theirs, declared))

    equal()

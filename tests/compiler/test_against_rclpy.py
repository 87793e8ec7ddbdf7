"""The bytes that are published equal those of rclpy, for every type in use and for many that could be."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from router.compiler.lookup import Definitions
from router.engine.delivery import MAPPING_FAILURES
from router.types.model import MessageType
from tests.compiler.comparing import assert_same_message, same
from tests.compiler.compiling import AUTO, context_of, outcome, scope_of, serializer
from tests.compiler.generated_types import mirror, values
from tests.compiler.in_use import ROS_TYPES
from tests.oracles.reference import fill

pytest.importorskip("rclpy")

from tests.compiler.ros_objects import deserialized, serialized

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
    if value is MAPPING_FAILURES or ours is MAPPING_FAILURES:
        assert value is ours
        return
    assert_same_message(ours, serialized(declared.name, value), declared, value)
    assert same(deserialized(declared.name, ours), value)


@pytest.mark.parametrize("name", [*ROS_TYPES, *OTHERS])
def test_type_is_written_as_rclpy_does(definitions: Definitions, name: str) -> None:
    declared = definitions.interfaces.get(name)
    assert declared is not None
    source = mirror(declared)

    @settings(max_examples=25, suppress_health_check=list(HealthCheck))
    @given(values(source))
    def equal(message: Any) -> None:
        assert_equal_bytes(declared, source, message)

    equal()

from __future__ import annotations

from typing import Any

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, Joy
from std_msgs.msg import Header

from demo.ros_messages import filled, message_class
from router.values.printing import ros_json

STAMP = Header().stamp


@pytest.mark.parametrize(
    "name",
    [
        "std_msgs/msg/Bool",
        "std_msgs/msg/Byte",
        "std_msgs/msg/ByteMultiArray",
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/MultiDOFJointState",
        "sensor_msgs/msg/Image",
    ],
)
def test_every_type_can_be_filled_and_sent(name: str) -> None:
    kind: Any = message_class(name)
    message = filled(kind, 200, STAMP)
    assert deserialize_message(serialize_message(message), kind) == message


def test_numbers_follow_from_the_number_and_times_are_the_stamp() -> None:
    stamp = Header().stamp
    stamp.sec = 7
    said = ros_json(filled(Imu, 4, stamp))
    assert said["header"] == {"stamp": {"sec": 7, "nanosec": 0}, "frame_id": "demo"}
    assert said["linear_acceleration_covariance"] == [5.0] * 9


def test_sequences_have_a_few_elements() -> None:
    assert list(filled(Joy, 1, STAMP).axes) == [2.0, 2.0, 2.0]

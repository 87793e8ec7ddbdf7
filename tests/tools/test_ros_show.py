from __future__ import annotations

import json
import math
from typing import Any

import pytest
from geometry_msgs.msg import Inertia, Point, Point32, Polygon, Vector3
from sensor_msgs.msg import Imu, LaserScan
from std_msgs.msg import Byte, ByteMultiArray, Empty, Header, String

from router.tools.ros_show import ros_json, ros_words


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (Empty(), []),
        (Point(), []),
        (Point(x=-0.0, y=0.1), ["y=0.1"]),
        (Point32(x=0.1), ["x=0.1"]),
        (Byte(data=b"\x07"), ["data=7"]),
        (ByteMultiArray(data=[b"\x00", b"\x07"]), ["data=[0,7]"]),
        (Header(frame_id="map"), ["frame_id=map"]),
        (Inertia(com=Vector3(x=1.0)), ["com.x=1.0"]),
        (Polygon(points=[Point32(x=1.0), Point32(y=math.inf)]), ["points[0].x=1", "points[1].y=inf"]),
        (LaserScan(ranges=[1.0, 0.1]), ["ranges=[1,0.1]"]),
    ],
)
def test_what_is_not_zero_is_shown_by_its_path(message: Any, words: list[str]) -> None:
    assert list(ros_words(message)) == words


def test_long_arrays_are_cut() -> None:
    scan = LaserScan(ranges=[1.0] * 360)
    assert list(ros_words(scan)) == ["ranges=[1,1,1,1,1,1,1,1,...](360)"]
    many = Polygon(points=[Point32(x=float(n)) for n in range(1, 12)])
    assert list(ros_words(many))[-2:] == ["points[7].x=8", "points=...(11)"]


def test_json_has_every_field() -> None:
    imu = Imu(header=Header(frame_id="imu"))
    imu.angular_velocity.x = math.nan
    said = json.loads(json.dumps(ros_json(imu), allow_nan=False))
    assert said["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "imu"}
    assert said["angular_velocity"] == {"x": "NaN", "y": 0.0, "z": 0.0}
    assert said["linear_acceleration_covariance"] == [0.0] * 9


def test_json_has_numbers_for_octets_and_words_for_infinities() -> None:
    assert ros_json(ByteMultiArray(data=[b"\x07"]))["data"] == [7]
    assert ros_json(Point(x=math.inf, y=-math.inf)) == {"x": "Infinity", "y": "-Infinity", "z": 0.0}
    assert ros_json(String(data="a b")) == {"data": "a b"}

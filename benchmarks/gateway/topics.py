"""The ROS topics of the load: their types, QoS, and prepared messages with room for the time. Knows no process."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from geometry_msgs.msg import Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped, Twist, Vector3
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, JointState, NavSatFix
from std_msgs.msg import Float64, Header, String

_SECONDS = 0x51525354
_NANOSECONDS = 0x31323334
_FLOAT = struct.unpack("<d", bytes(range(0x41, 0x49)))[0]
_CHARACTERS = "TIME_OF_SENDING_0"
_MARKS = {
    "time": struct.pack("<iI", _SECONDS, _NANOSECONDS),
    "float": struct.pack("<d", _FLOAT),
    "characters": _CHARACTERS.encode(),
}
"""By the kinds of stamps that ros_load.c knows: what stands in a message where it writes the time."""

_STAMP = re.compile(rb'"stamp":\[\{"nanosec":\[(\d+)\],"sec":\[(\d+)\]\}\]')


class Kind(NamedTuple):
    """A type of messages. `read` finds the stamp, wall-clock seconds, in the JSON text of one."""

    type_name: str
    stamp: str
    message: Any
    read: Callable[[bytes], float]


def _of_header(text: bytes) -> float:
    found = _STAMP.search(text)
    if not found:
        raise ValueError("the message has no time")
    return int(found[2]) + int(found[1]) * 1e-9


def _header(frame: str) -> Header:
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = _SECONDS, _NANOSECONDS
    return header


def _noise(count: int) -> list[float]:
    """Numbers with all their digits, as sensors have them."""
    return [round(0.1 + index * 0.6180339887 % 3, 10) - 1.5 for index in range(count)]


def _vector(scale: float) -> Vector3:
    x, y, z = _noise(3)
    return Vector3(x=x * scale, y=y * scale, z=z * scale)


_JOINTS = [f"wheel_{side}_{end}_joint" for side in ("left", "right") for end in ("front", "middle", "rear")]
IMU = Kind(
    "sensor_msgs/msg/Imu", "time",
    Imu(header=_header("imu_link"), angular_velocity=_vector(0.1), linear_acceleration=_vector(9.81),
        orientation_covariance=_noise(9)),
    _of_header,
)  # fmt: skip
KINDS = (
    IMU,
    Kind(
        "geometry_msgs/msg/Twist", "float", Twist(linear=Vector3(x=_FLOAT, y=0.0, z=0.0), angular=_vector(1.0)),
        lambda text: float(json.loads(text)["linear"][0]["x"][0]),
    ),
    Kind("std_msgs/msg/Float64", "float", Float64(data=_FLOAT), lambda text: float(json.loads(text)["data"][0])),
    Kind(
        "std_msgs/msg/String", "characters", String(data=f"{_CHARACTERS} the drive is ready, all six wheels turn"),
        lambda text: float(json.loads(text)["data"][0].split()[0]),
    ),
    Kind(
        "sensor_msgs/msg/NavSatFix", "time",
        NavSatFix(header=_header("gps"), latitude=51.4778123, longitude=-0.0014712, altitude=46.25,
                  position_covariance=_noise(9)),
        _of_header,
    ),
    Kind(
        "sensor_msgs/msg/JointState", "time",
        JointState(header=_header(""), name=_JOINTS, position=_noise(6), velocity=_noise(6), effort=_noise(6)),
        _of_header,
    ),
    # Half of an Odometry, whose package is not among the router's dependencies.
    Kind(
        "geometry_msgs/msg/PoseWithCovarianceStamped", "time",
        PoseWithCovarianceStamped(
            header=_header("map"),
            pose=PoseWithCovariance(pose=Pose(position=Point(x=12.25, y=-3.125, z=0.5)), covariance=_noise(36)),
        ),
        _of_header,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """`qos` as ros_load.c knows it."""

    name: str
    kind: Kind
    qos: str
    hertz: float

    def line(self) -> str:
        """As ros_load.c reads it."""
        cdr, mark = serialize_message(self.kind.message), _MARKS[self.kind.stamp]
        if cdr.count(mark) != 1:
            raise ValueError(f"{self.kind.type_name} has {cdr.count(mark)} places for the time")
        words = (self.name, self.kind.type_name, self.qos, self.hertz, self.kind.stamp, cdr.index(mark), cdr.hex())
        return " ".join(map(str, words))


def many(count: int, hertz: float, qos: Sequence[str]) -> list[Topic]:
    """Types and QoS in turns."""
    return [
        Topic(f"/bench/topic_{number}", KINDS[number % len(KINDS)], qos[number % len(qos)], hertz)
        for number in range(count)
    ]


def write(topics: Sequence[Topic], path: Path) -> None:
    """The file for ros_load.c."""
    path.write_text("".join(f"{topic.line()}\n" for topic in topics), encoding="utf-8")

"""Plausible, smoothly moving values for every payload that a simulated endpoint sends."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from google.protobuf.message import Message

from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type

METRES_PER_DEGREE = 111_320.0
"""Of latitude, and of longitude at the equator."""

START = (51.0993, 17.0184)
"""Latitude and longitude of the centre of the walk, degrees."""


@dataclass(frozen=True, slots=True)
class Pose:
    """The simulated rover at one time: a figure of eight of 20 by 10 metres, walked in about two minutes.

    `t` seconds since the start, `north` and `east` metres, `heading` degrees clockwise from north,
    `speed` m/s, `turn_rate` degrees per second, positive to the right. `epoch` is the wall clock at the
    start in seconds.
    """

    t: float
    epoch: float
    north: float
    east: float
    heading: float
    speed: float
    turn_rate: float


def pose(t: float, epoch: float) -> Pose:
    """Return the pose `t` seconds after the start."""
    rate = math.tau / 120
    phase = rate * t
    east, north = 10 * math.sin(phase), 5 * math.sin(2 * phase)
    v_east, v_north = 10 * rate * math.cos(phase), 10 * rate * math.cos(2 * phase)
    a_east, a_north = -10 * rate**2 * math.sin(phase), -20 * rate**2 * math.sin(2 * phase)
    speed = math.hypot(v_east, v_north)
    heading = math.degrees(math.atan2(v_east, v_north)) % 360
    turn_rate = math.degrees((v_north * a_east - v_east * a_north) / speed**2)
    return Pose(t, epoch, north, east, heading, speed, turn_rate)


Noise = Callable[[float], float]
"""A function from a standard deviation to one sample of Gaussian noise."""

Values = Mapping[str, object]


def _imu(now: Pose, noise: Noise) -> Values:
    """Level, gravity up, turning with the walk; m/s^2, deg/s, microtesla."""
    heading = math.radians(now.heading)
    return {
        "accel_x": noise(0.02),
        "accel_y": noise(0.02),
        "accel_z": 9.80665 + noise(0.02),
        "gyro_x": noise(0.05),
        "gyro_y": noise(0.05),
        "gyro_z": -now.turn_rate + noise(0.05),
        "mag_x": 19.0 * math.cos(heading) + noise(0.2),
        "mag_y": 19.0 * math.sin(heading) + noise(0.2),
        "mag_z": -45.0 + noise(0.2),
        "is_calibrated": True,
    }


def _gps(now: Pose, noise: Noise) -> Values:
    latitude, longitude = START
    return {
        "latitude": latitude + (now.north + noise(0.02)) / METRES_PER_DEGREE,
        "longitude": longitude + (now.east + noise(0.02)) / METRES_PER_DEGREE / math.cos(math.radians(latitude)),
        "altitude": 121.0 + noise(0.1),
        "speed": now.speed,
        "heading": now.heading,
        "hdop": 0.9 + abs(noise(0.02)),
        "vdop": 1.4 + abs(noise(0.02)),
        "satellites": 14 + round(2 * math.sin(now.t / 20)),
        "fix_quality": 4,
        "utc_timestamp": int((now.epoch + now.t) * 1000),
    }


def _ph(now: Pose, noise: Noise) -> Values:
    value = 6.8 + 0.4 * math.sin(now.t / 15) + noise(0.01)
    return {"ph_value": value, "voltage": 2.5 - 0.177 * (value - 7), "temperature": 22 + 2 * math.sin(now.t / 60)}


def _pressure(now: Pose, noise: Noise) -> Values:
    kpa = 99.8 + 0.3 * math.sin(now.t / 20) + noise(0.01)
    celsius = 23 + 1.5 * math.sin(now.t / 45)
    return {"pressure_kpa": kpa, "temperature_c": celsius, "voltage": kpa / 40, "is_calibrated": True}


def _load_cell(now: Pose, noise: Noise) -> Values:
    newtons = 4 + 3 * math.sin(now.t / 10) + noise(0.02)
    scale = 0.0005
    return {
        "force_newtons": newtons,
        "mass_grams": newtons / 9.80665 * 1000,
        "raw_counts": round(newtons / scale) + 8000,
        "is_calibrated": True,
        "scale_newtons_per_count": scale,
        "tare_offset_counts": 8000,
    }


def _motor(now: Pose, noise: Noise) -> Values:
    """A wheel of 25 cm that follows the walk."""
    turns = now.speed / (math.pi * 0.25)
    return {"rpm": 60 * turns + noise(0.2), "voltage": 24 + noise(0.1), "encoder_angle": 360 * turns * now.t % 360}


def _sensor_board(now: Pose, noise: Noise) -> Values:
    return {"board_temperature": 35 + 3 * math.sin(now.t / 60) + noise(0.1), "board_voltage": 5 + noise(0.01)}


def _manual_drive(now: Pose, noise: Noise) -> Values:
    return {"forward_backward": round(60 + 30 * math.sin(now.t / 8)), "turn": round(40 * math.sin(now.t / 5))}


def _manual_brake(now: Pose, noise: Noise) -> Values:
    """Always off, so that a brake at the driving board comes from a deadman."""
    return {"brake": False}


def _control_mode(now: Pose, noise: Noise) -> Values:
    """Always autonomous, so that a table that asks for it lets commands of the software pass."""
    return {"mode": 1}


def _timestamp(now: Pose, noise: Noise) -> Values:
    return _seconds(now.epoch + now.t)


def _duration(now: Pose, noise: Noise) -> Values:
    """Since the start."""
    return _seconds(now.t)


def _seconds(seconds: float) -> Values:
    """In whole microseconds, as a float has no more digits for the wall clock."""
    whole, microseconds = divmod(round(seconds * 1e6), 1_000_000)
    return {"seconds": whole, "nanos": 1000 * microseconds}


def _any(now: Pose, noise: Noise) -> Values:
    """Nothing: which types the receiver knows is not known here."""
    return {"type_url": "", "value": b""}


MODELS: Mapping[str, Callable[[Pose, Noise], Values]] = {
    "SensorBoardIMUInfo": _imu,
    "SensorBoardGPSInfo": _gps,
    "SensorBoardPHInfo": _ph,
    "SensorBoardPressureInfo": _pressure,
    "SensorBoardLoadCellInfo": _load_cell,
    "SensorBoardDiagnostics": _sensor_board,
    "MotorInformation": _motor,
    "BasestationManualDrive": _manual_drive,
    "BasestationManualBrake": _manual_brake,
    "BasestationControlMode": _control_mode,
    "google.protobuf.Timestamp": _timestamp,
    "google.protobuf.Duration": _duration,
    "google.protobuf.Any": _any,
}
"""Functions that return the modelled fields, by protobuf message; all other fields vary as their types allow."""


RATES: Mapping[str, float] = {
    "imu_info": 50,
    "gps_info": 5,
    "pressure_info": 5,
    "load_cell_info": 5,
    "sensor_diag": 1,
    "pump_info": 1,
    "drive_diag": 10,
    "drive_progress": 10,
    "arm_diag": 5,
    "arm_pos": 10,
    "arm_feedback": 5,
    "manual_drive": 20,
    "manual_arm": 20,
    "control_mode": 1,
    "object_selection": 1,
    "rock_measure_request": 1,
}
"""Usual rate of a payload case on the rover, Hz."""

USUAL_RATE = 2.0
"""Rate of a payload case that is not in RATES, Hz."""

NESTING = 3
"""Depth to which recursive messages are filled."""

NAMING = ("_id", "index")
"""Suffixes of integer fields that are identifiers; these stay constant."""

HEALTHY = ("OPERATING", "_OK", "NO_ERROR")
"""Suffixes of enum values that mean health; these fields stay constant."""


class PayloadModel:
    """The values of one payload case over time. The same seed and times give the same messages.

    `lengths` are those of lists and bytes by their paths (`lengths.needed_lengths`); the others are short.
    """

    def __init__(self, name: str, kind: MessageType, seed: int, lengths: Mapping[str, int] | None = None) -> None:
        self._name, self._kind, self._seed, self._lengths = name, kind, seed, lengths or {}
        self._random = random.Random(f"{seed}/{name}")
        self._phases: dict[str, float] = {}

    def fill(self, message: Message, now: Pose) -> None:
        """Set every field of an empty message, down to a depth of NESTING; below that, only required ones."""
        self._fill(message, self._kind, now, self._name, NESTING)

    def _fill(self, message: Any, kind: MessageType, now: Pose, path: str, depth: int) -> None:
        model = MODELS.get(kind.name)
        values = {} if model is None else model(now, self._noise)
        for field in kind.fields:
            if field.name in values:
                setattr(message, field.name, values[field.name])
            elif depth >= 0 or field.is_required:
                self._fill_field(message, field, now, f"{path}.{field.name}", depth)

    def _fill_field(self, message: Any, field: Field, now: Pose, path: str, depth: int) -> None:
        member = getattr(message, field.name)
        if isinstance(field.type, MessageType):
            member.SetInParent()
            self._fill(member, field.type, now, path, depth - 1)
        elif not isinstance(field.type, List):
            setattr(message, field.name, self._value(field.type, now, path))
        elif field.type.entry is not None:
            self._fill_map(member, field.type, now, path, depth)
        elif isinstance(field.type.element, MessageType):
            for index in range(self._length(field.type, path) if depth > 0 else 0):
                self._fill(member.add(), field.type.element, now, f"{path}[{index}]", depth - 1)
        else:
            element = field.type.element
            length = self._length(field.type, path)
            member.extend(self._value(element, now, f"{path}[{index}]") for index in range(length))

    def _fill_map(self, member: Any, kind: List, now: Pose, path: str, depth: int) -> None:
        assert kind.entry is not None  # noqa: S101 - it is a map
        key, content = (field.type for field in kind.entry.fields)
        for index in range(self._length(kind, path) if depth > 0 else 0):
            at = _key(key, index)
            if isinstance(content, MessageType):
                self._fill(member.get_or_create(at), content, now, f"{path}[{index}]", depth - 1)
            else:
                member[at] = self._value(content, now, f"{path}[{index}]")

    def _value(self, kind: Type, now: Pose, path: str) -> object:
        """Return a value of a scalar type: waves of half a minute, each path with a phase of its own."""
        wave = math.sin(now.t * math.tau / 30 + self._phase(path))
        if isinstance(kind, Float):
            return 10 * wave + self._noise(0.05)
        if isinstance(kind, Int) and path.endswith(NAMING):
            return int(self._phase(path))
        if isinstance(kind, Int):
            return round(50 * (wave + (0 if kind.signed else 1)))
        if isinstance(kind, Bool):
            return wave > 0
        if isinstance(kind, Enum):
            return _enum_value(kind, wave)
        text = f"{self._name} {now.t:.1f}"[: kind.bound if isinstance(kind, (String, Bytes)) else None]
        return text if isinstance(kind, String) else self._octets(text, path)

    def _octets(self, text: str, path: str) -> bytes:
        length = self._lengths.get(_without_indexes(path), len(text))
        return text.encode()[:length].ljust(length, b"\0")

    def _length(self, kind: List, path: str) -> int:
        return self._lengths.get(_without_indexes(path), _usual_length(kind))

    def _phase(self, path: str) -> float:
        if path not in self._phases:
            self._phases[path] = random.Random(f"{self._seed}/{path}").uniform(0, math.tau)
        return self._phases[path]

    def _noise(self, deviation: float) -> float:
        return self._random.gauss(0.0, deviation)


def _usual_length(kind: List) -> int:
    return kind.length if kind.length is not None else min(3, 3 if kind.bound is None else kind.bound)


def _without_indexes(path: str) -> str:
    return re.sub(r"\[\d+\]", "", path)


def _key(kind: Type, index: int) -> object:
    """Return the key of a map's entry at this index."""
    if isinstance(kind, String):
        return str(index)
    return bool(index % 2) if isinstance(kind, Bool) else index


def _enum_value(kind: Enum, wave: float) -> int:
    """Return the value that means health if the enum has one, else each value in turn."""
    for name, number in kind.values:
        if name.endswith(HEALTHY):
            return number
    position = min(int((wave + 1) / 2 * len(kind.values)), len(kind.values) - 1)
    return kind.values[position][1]

"""A rover walking a figure of eight: what its sensors and motors then say, and how often.

Plain functions of time. Which messages they end up in, and what other fields hold, is `payload_model`'s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

METRES_PER_DEGREE = 111_320.0
"""Of latitude, and of longitude at the equator."""

START = (51.0993, 17.0184)
"""Latitude and longitude of the middle of the walk, degrees."""


@dataclass(frozen=True, slots=True)
class Moment:
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


def moment(t: float, epoch: float) -> Moment:
    """Where the rover is `t` seconds after the start."""
    rate = math.tau / 120
    phase = rate * t
    east, north = 10 * math.sin(phase), 5 * math.sin(2 * phase)
    v_east, v_north = 10 * rate * math.cos(phase), 10 * rate * math.cos(2 * phase)
    a_east, a_north = -10 * rate**2 * math.sin(phase), -20 * rate**2 * math.sin(2 * phase)
    speed = math.hypot(v_east, v_north)
    heading = math.degrees(math.atan2(v_east, v_north)) % 360
    turn_rate = math.degrees((v_north * a_east - v_east * a_north) / speed**2)
    return Moment(t, epoch, north, east, heading, speed, turn_rate)


Noise = Callable[[float], float]
"""A standard deviation to one sample of Gaussian noise."""

Values = Mapping[str, object]


def _imu(now: Moment, noise: Noise) -> Values:
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


def _gps(now: Moment, noise: Noise) -> Values:
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


def _ph(now: Moment, noise: Noise) -> Values:
    value = 6.8 + 0.4 * math.sin(now.t / 15) + noise(0.01)
    return {"ph_value": value, "voltage": 2.5 - 0.177 * (value - 7), "temperature": 22 + 2 * math.sin(now.t / 60)}


def _pressure(now: Moment, noise: Noise) -> Values:
    kpa = 99.8 + 0.3 * math.sin(now.t / 20) + noise(0.01)
    celsius = 23 + 1.5 * math.sin(now.t / 45)
    return {"pressure_kpa": kpa, "temperature_c": celsius, "voltage": kpa / 40, "is_calibrated": True}


def _load_cell(now: Moment, noise: Noise) -> Values:
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


def _motor(now: Moment, noise: Noise) -> Values:
    """A wheel of 25 cm that follows the walk."""
    turns = now.speed / (math.pi * 0.25)
    return {"rpm": 60 * turns + noise(0.2), "voltage": 24 + noise(0.1), "encoder_angle": 360 * turns * now.t % 360}


def _sensor_board(now: Moment, noise: Noise) -> Values:
    return {"board_temperature": 35 + 3 * math.sin(now.t / 60) + noise(0.1), "board_voltage": 5 + noise(0.01)}


def _manual_drive(now: Moment, noise: Noise) -> Values:
    return {"forward_backward": round(60 + 30 * math.sin(now.t / 8)), "turn": round(40 * math.sin(now.t / 5))}


def _manual_brake(now: Moment, noise: Noise) -> Values:
    """Off while the operator drives: a brake at the driving board is a deadman's."""
    return {"brake": False}


MODELS: Mapping[str, Callable[[Moment, Noise], Values]] = {
    "SensorBoardIMUInfo": _imu,
    "SensorBoardGPSInfo": _gps,
    "SensorBoardPHInfo": _ph,
    "SensorBoardPressureInfo": _pressure,
    "SensorBoardLoadCellInfo": _load_cell,
    "SensorBoardDiagnostics": _sensor_board,
    "MotorInformation": _motor,
    "BasestationManualDrive": _manual_drive,
    "BasestationManualBrake": _manual_brake,
}
"""By protobuf message; the fields that a model does not give move as their types allow."""


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
"""How often a payload case is sent in real life, Hz."""

USUAL_RATE = 2.0


def usual_rate(case: str) -> float:
    """Hz, also of a payload case that nobody has described here yet."""
    return RATES.get(case, USUAL_RATE)

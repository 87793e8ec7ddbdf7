"""The expected messages for a payload or a ROS message, computed from units and directions without the router."""

from __future__ import annotations

import math
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from tests.acceptance.payloads import WIRE, Sample, sample
from tests.acceptance.rover_map import FLOWS
from tests.wire.test_golden_envelopes import values_of

_NO_PLACE = {("SensorBoardDiagnostics", "load_cell"), ("SensorBoardDiagnostics", "pressure_sensor")}
_RENAMED = {("SensorBoardDiagnostics", "gps_sensor_1"): "gps_sensor"}

Values = dict[str, Any]


def expected_messages(case: str, payload: Any) -> dict[str, Values]:
    """The expected messages by topic. A stamp is `None`, because it is the time of arrival."""
    standard = _STANDARD.get(case, lambda _: {})
    return {FLOWS[case].topic: in_board_units(payload), **standard(payload)}


def in_board_units(payload: Any) -> Values:
    """The `comms` message: the same fields, an enum as `uint8` that saturates, a sensor's state in its own message."""
    values: Values = {}
    kind = payload.DESCRIPTOR.name
    for field in payload.DESCRIPTOR.fields:
        if (kind, field.name) not in _NO_PLACE:
            name = _RENAMED.get((kind, field.name), field.name)
            values[name] = _in_board_units(field, getattr(payload, field.name))
    return values


def _in_board_units(field: FieldDescriptor, value: Any) -> Any:
    if field.message_type is not None:
        return in_board_units(value)
    if field.enum_type is None:
        return value
    byte = min(max(value, 0), 255)
    return {"state": byte} if field.enum_type.name == "SensorState" else byte


def from_board_units(case: str, values: Values) -> Sample:
    """The inverse: the payload expected for a `comms` message. A ROS message cannot leave a nested message out."""
    payload = WIRE.envelopes.first.cases[case].message_class()
    _fill(payload, values)
    return sample(case, payload)


def _fill(message: Any, values: Values) -> None:
    kind = message.DESCRIPTOR.name
    for field in message.DESCRIPTOR.fields:
        name = _RENAMED.get((kind, field.name), field.name)
        if name not in values:
            continue
        if field.message_type is not None:
            getattr(message, field.name).SetInParent()
            _fill(getattr(message, field.name), values[name])
        else:
            value = values[name]
            setattr(message, field.name, value["state"] if isinstance(value, dict) else value)


def same_datagram(one: bytes, other: bytes) -> bool:
    """Whether two datagrams have the same bytes, except that all NaNs are equal."""
    return one == other or _decoded(one) == _decoded(other)


def _decoded(datagram: bytes) -> tuple[str, Any]:
    decoded = WIRE.decode(datagram)
    return decoded.case.name, spelled(values_of(decoded.message, {}))


def spelled(value: Any) -> Any:
    """A form that compares exactly: -0.0 differs from 0.0, NaN equals NaN, and an integer differs from a float."""
    if isinstance(value, dict):
        return {name: spelled(member) for name, member in value.items()}
    if isinstance(value, list):
        return [spelled(element) for element in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else repr(value)


def _header(frame: str) -> Values:
    return {"stamp": None, "frame_id": frame}


def _xyz(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Values:
    return {"x": x, "y": y, "z": z}


def _temperature(frame: str, celsius: float) -> Values:
    return {"header": _header(frame), "temperature": celsius, "variance": 0.0}


def _sensor_board(diag: Any) -> dict[str, Values]:
    return {"sensor_board/temperature": _temperature("sensor_board", diag.board_temperature)}


def _imu(imu: Any) -> dict[str, Values]:
    unknown = [0.0] * 9
    turning = (math.radians(rate) for rate in (imu.gyro_x, imu.gyro_y, imu.gyro_z))
    tesla = (microtesla / 1e6 for microtesla in (imu.mag_x, imu.mag_y, imu.mag_z))
    return {
        "imu/data_raw": {
            "header": _header("imu_link"),
            "orientation": {**_xyz(), "w": 1.0},
            "orientation_covariance": [-1.0, *unknown[1:]],
            "angular_velocity": _xyz(*turning),
            "angular_velocity_covariance": unknown,
            "linear_acceleration": _xyz(imu.accel_x, imu.accel_y, imu.accel_z),
            "linear_acceleration_covariance": unknown,
        },
        "imu/mag": {
            "header": _header("imu_link"),
            "magnetic_field": _xyz(*tesla),
            "magnetic_field_covariance": unknown,
        },
    }


_FIX_STATUS = {1: 0, 2: 1, 3: 0, 4: 2, 5: 2}
"""NavSatStatus by fix quality: plain, satellite-augmented (DGPS), ground-augmented (RTK); else none."""


def _gps(gps: Any) -> dict[str, Values]:
    across, up = (4 * gps.hdop) ** 2, (4 * gps.vdop) ** 2
    east, north = math.sin(math.radians(gps.heading)), math.cos(math.radians(gps.heading))
    return {
        "gps/fix": {
            "header": _header("gps_link"),
            "status": {"status": _FIX_STATUS.get(gps.fix_quality, -1), "service": 1},
            "latitude": gps.latitude,
            "longitude": gps.longitude,
            "altitude": gps.altitude,
            "position_covariance": [across, 0.0, 0.0, 0.0, across, 0.0, 0.0, 0.0, up],
            "position_covariance_type": 1 if min(gps.hdop, gps.vdop) > 0 else 0,
        },
        "gps/vel": {
            "header": _header("gps_enu"),
            "twist": {"linear": _xyz(gps.speed * east, gps.speed * north), "angular": _xyz()},
        },
    }


def _ph(ph: Any) -> dict[str, Values]:
    return {"ph/temperature": _temperature("ph_probe", ph.temperature)}


def _pressure(pressure: Any) -> dict[str, Values]:
    frame = f"pressure_sensor_{pressure.sensor_index}"
    pascal = pressure.pressure_kpa * 1000.0
    return {
        "pressure/data": {"header": _header(frame), "fluid_pressure": pascal, "variance": 0.0},
        "pressure/temperature": _temperature(frame, pressure.temperature_c),
    }


_STANDARD = {
    "sensor_diag": _sensor_board,
    "imu_info": _imu,
    "gps_info": _gps,
    "ph_info": _ph,
    "pressure_info": _pressure,
}

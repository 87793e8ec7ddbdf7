"""`schemas/comms` against the protobuf messages that it mirrors, and against what is fixed on the rover."""

from __future__ import annotations

import importlib

import pytest

from router.types.model import Bool, Enum, Float, Int, MessageType, Type
from router.types.protobuf import Envelope
from router.types.ros import RosInterfaces, definition, ros_interfaces

FIXED = {
    "SensorState": "uint8 state",
    "ImuSensorInformation": (
        "float accel_x, float accel_y, float accel_z, float gyro_x, float gyro_y, float gyro_z, "
        "float mag_x, float mag_y, float mag_z, boolean is_calibrated, comms/SensorState state, uint8 error_code"
    ),
    "SensorBoardGPSInfo": (
        "double latitude, double longitude, float altitude, float speed, float heading, float hdop, float vdop, "
        "int32 satellites, uint8 fix_quality, comms/SensorState state, uint8 error_code, int64 utc_timestamp"
    ),
    "SensorBoardPHInfo": (
        "float ph_value, float voltage, float temperature, comms/SensorState state, uint8 error_code"
    ),
    "SensorBoardDiagnostics": (
        "uint8 state, comms/ImuSensorInformation imu_sensor, comms/SensorBoardGPSInfo gps_sensor, "
        "comms/SensorBoardPHInfo ph_sensor, float board_temperature, float board_voltage"
    ),
}
OTHER_NAMES = {"SensorBoardIMUInfo": "ImuSensorInformation"}
OTHER_FIELDS = {("SensorBoardDiagnostics", "gps_sensor_1"): "gps_sensor"}
WITHOUT_PLACE = {("SensorBoardDiagnostics", "load_cell"), ("SensorBoardDiagnostics", "pressure_sensor")}


@pytest.fixture(scope="module")
def interfaces() -> RosInterfaces:
    return ros_interfaces()


def comms(interfaces: RosInterfaces, proto_name: str) -> MessageType:
    found = interfaces.get(f"comms/msg/{OTHER_NAMES.get(proto_name, proto_name)}")
    assert found is not None, proto_name
    return found


@pytest.mark.parametrize("name", FIXED)
def test_existing_interface_keeps_order_names_and_types(interfaces: RosInterfaces, name: str) -> None:
    fields = definition(comms(interfaces, name))
    assert ", ".join(f"{kind} {field}" for field, kind in fields) == FIXED[name]


def disagreements(proto: MessageType, interfaces: RosInterfaces) -> list[str]:
    """Where a protobuf message and its ROS message differ, nested messages included."""
    ros = comms(interfaces, proto.name)
    found = []
    for field in proto.fields:
        if (proto.name, field.name) in WITHOUT_PLACE:
            continue
        mirror = ros.field(OTHER_FIELDS.get((proto.name, field.name), field.name))
        if mirror is None:
            found.append(f"{ros} has no {field.name}")
        elif isinstance(field.type, MessageType):
            found += disagreements(field.type, interfaces)
            if mirror.type is not comms(interfaces, field.type.name):
                found.append(f"{ros}.{field.name} is {mirror.type}")
        elif not mirrors(field.type, mirror.type, ros):
            found.append(f"{ros}.{field.name} is {mirror.type}, not {field.type}")
    return found


def mirrors(proto: Type, ros: Type, owner: MessageType) -> bool:
    if isinstance(proto, Enum):
        if isinstance(ros, MessageType):
            return ros.short_name == proto.name and ros.constants == dict(proto.values)
        return ros == Int(8, signed=False) and owner.constants.items() >= dict(proto.values).items()
    assert isinstance(proto, Bool | Int | Float)
    return ros == proto


def test_every_payload_has_a_message_of_the_same_fields_and_constants(
    interfaces: RosInterfaces, envelope: Envelope
) -> None:
    assert [found for case in envelope.cases.values() for found in disagreements(case.type, interfaces)] == []


def test_built_package_is_what_the_definitions_say(interfaces: RosInterfaces) -> None:
    module = importlib.import_module("comms.msg")
    names = [name for name in interfaces.names() if name.startswith("comms/msg/")]
    assert {name.rpartition("/")[2] for name in names} == {name for name in vars(module) if name[0].isupper()}
    for name in names:
        message = interfaces.get(name)
        assert message is not None
        built = getattr(module, message.short_name).get_fields_and_field_types()
        assert tuple(built.items()) == definition(message), name

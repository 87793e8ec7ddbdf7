"""The expected behaviour of the rover's table, written from the list of directions and not from the table."""

from __future__ import annotations

from typing import NamedTuple


class Flow(NamedTuple):
    """One inbound payload case. `topic` carries it in the board's units, as `comms/msg/{type}`."""

    source: str
    destinations: tuple[str, ...]
    topic: str
    type: str


_B = ("basestation",)

FLOWS = {
    "ph_info": Flow("sensor_board", _B, "ph_data", "SensorBoardPHInfo"),
    "arm_diag": Flow("arm_board", _B, "arm_diag", "ArmBoardDiagnostics"),
    "arm_feedback": Flow("arm_board", (), "arm_feedback", "ArmBoardMovementFeedback"),
    "arm_pos": Flow("arm_board", _B, "arm_pos", "ArmBoardActualPositions"),
    "arm_obstructions": Flow("arm_board", (), "arm_obstructions", "ArmBoardObstructions"),
    "drive_diag": Flow("driving_board", _B, "drive_diag", "DrivingBoardDiagnostics"),
    "drive_progress": Flow("driving_board", (), "drive_progress", "DrivingBoardMotorPeriodicProgress"),
    "sensor_diag": Flow("sensor_board", _B, "sensor_board_diagnostics", "SensorBoardDiagnostics"),
    "gps_info": Flow("sensor_board", _B, "gps_data", "SensorBoardGPSInfo"),
    "imu_info": Flow("sensor_board", _B, "imu_data", "ImuSensorInformation"),
    "load_cell_info": Flow("sensor_board", _B, "load_cell_info", "SensorBoardLoadCellInfo"),
    "pressure_info": Flow("sensor_board", _B, "pressure_info", "SensorBoardPressureInfo"),
    "control_mode": Flow("basestation", (), "control_mode", "BasestationControlMode"),
    "object_selection": Flow("basestation", (), "object_selection", "BasestationObjectSelection"),
    "rock_measure_request": Flow("basestation", (), "rock_measure_request", "BasestationRockMeasureRequest"),
    "flow_sensor_info": Flow("sensor_board", _B, "flow_sensor_info", "SensorBoardFlowSensorInfo"),
    "pump_info": Flow("sensor_board", _B, "pump_info", "SensorBoardPumpInfo"),
    "manual_drive": Flow("basestation", ("driving_board",), "manual_drive", "BasestationManualDrive"),
    "manual_brake": Flow("basestation", ("driving_board",), "manual_brake", "BasestationManualBrake"),
    "manual_arm": Flow("basestation", ("arm_board",), "manual_arm", "BasestationManualArmMovement"),
}


class Outflow(NamedTuple):
    """One route from ROS. `route` is its label."""

    route: str
    destination: str
    type: str


OUTFLOWS = {
    "arm_ctrl": Outflow("arm_ctrl", "arm_board", "ArmBoardControlSignals"),
    "arm_target": Outflow("arm_target", "arm_board", "ArmBoardTargetMovement"),
    "drive_motor": Outflow("drive_motor", "driving_board", "DrivingBoardMotorMessage"),
    "detected_object": Outflow("detected_object_from_ros", "basestation", "BasestationDetectedObject"),
    "rock_measure_result": Outflow("rock_measure_result", "basestation", "BasestationRockMeasureResult"),
    "rover_localization": Outflow("rover_localization", "basestation", "BasestationRoverLocalization"),
}
"""Routes from ROS to UDP only, by payload case, which is also the topic."""

ARRAYS = "detected_objects"
"""The topic of `comms/msg/DetectedObjectArray`, whose elements are sent to the basestation one by one."""

ARRAY_ROUTE = "detected_object_from_ros_2"

TOPICS_FROM_ROS = {
    **{topic: f"comms/msg/{flow.type}" for topic, flow in OUTFLOWS.items()},
    ARRAYS: "comms/msg/DetectedObjectArray",
}

STANDARD = {
    "sensor_diag": {"sensor_board/temperature": "sensor_msgs/msg/Temperature"},
    "imu_info": {"imu/data_raw": "sensor_msgs/msg/Imu", "imu/mag": "sensor_msgs/msg/MagneticField"},
    "gps_info": {"gps/fix": "sensor_msgs/msg/NavSatFix", "gps/vel": "geometry_msgs/msg/TwistStamped"},
    "ph_info": {"ph/temperature": "sensor_msgs/msg/Temperature"},
    "pressure_info": {
        "pressure/data": "sensor_msgs/msg/FluidPressure",
        "pressure/temperature": "sensor_msgs/msg/Temperature",
    },
}
"""Additional topics of a payload case, with standard types."""

HOSTS = {
    "sensor_board": "127.0.0.30",
    "driving_board": "127.0.0.222",
    "arm_board": "127.0.0.40",
    "container_board": "127.0.0.50",
    "basestation": "127.0.0.10",
}
ROUTER = "127.0.0.5"


def topics_of(case: str) -> dict[str, str]:
    """ROS type by topic."""
    flow = FLOWS[case]
    return {flow.topic: f"comms/msg/{flow.type}", **STANDARD.get(case, {})}


TOPICS = {topic: kind for case in FLOWS for topic, kind in topics_of(case).items()}

"""`ros2 launch rover_router rover_router.launch.py [table:=PATH] ...`; `--show-args` lists the arguments."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = "rover_router"

ARGUMENTS = {
    "table": (str(Path(get_package_share_directory(PACKAGE), "routes", "rover.yaml")), "route table"),
    "params_file": ("", "YAML file of ROS parameters, which set the table's variables: basestation for ${BASESTATION}"),
    "name": ("", "name of the node; if empty, the table's"),
    "namespace": ("", "namespace of the node and its relative topics; if empty, the table's"),
    "log_level": ("info", "lowest level that is logged: debug, info, warning or error"),
    "respawn": ("false", "restart 2 s after an exit, even if the table has errors"),
}


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_router)])


def _router(context: LaunchContext) -> list[Node]:
    """A function, because an empty name, namespace or file must not be passed on."""
    chosen = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    return [
        Node(
            package=PACKAGE,
            executable="router",
            arguments=["run", chosen["table"], "--log-level", chosen["log_level"]],
            name=chosen["name"] or None,
            namespace=chosen["namespace"] or None,
            parameters=[chosen["params_file"]] if chosen["params_file"] else [],
            output="screen",
            respawn=chosen["respawn"].lower() == "true",
            respawn_delay=2.0,
        )
    ]

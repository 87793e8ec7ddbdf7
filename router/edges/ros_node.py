"""A ROS node in a context of its own. Knows no topics."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.node import Node

from router.errors import StartError

RCL_ERRORS = (RuntimeError, NameValidationException)
"""What rclpy raises for bad arguments, names and settings: its own errors derive from RuntimeError."""


def open_node(name: str, namespace: str = "/", ros_args: Sequence[str] = ()) -> Node:
    """Raises StartError. Signals are left alone, and rclpy's global context as well; close it with `close_node`."""
    context = Context()
    try:
        # The router has a log of its own: no log file of ROS, no /rosout. Nor parameter services:
        # parameters fill the table's variables at start, so a service that sets them would pretend.
        context.init(list(ros_args), initialize_logging=False)
        return Node(name, namespace=namespace, context=context, enable_rosout=False, start_parameter_services=False)
    except RCL_ERRORS as error:
        context.try_shutdown()
        raise StartError(f"the ROS node cannot be created: {error}") from error


def close_node(node: Node) -> None:
    node.destroy_node()
    node.context.try_shutdown()

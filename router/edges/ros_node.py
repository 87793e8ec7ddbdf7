"""A ROS node in a context of its own, and the installed classes of messages. Knows no table and no traffic."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

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


def installed_class(name: str) -> Any:
    """The Python class of `std_msgs/msg/String`. Raises StartError that says how to get it."""
    package, _, short = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError) as error:
        raise StartError(f"{name} is not installed ({error}); {remedy(name)}") from error


def remedy(name: str) -> str:
    """What to do when the installed type is missing or another one."""
    return f"run 'make setup', or install the ROS package '{name.partition('/')[0]}'"

"""Which ROS 2 is installed, and whether its message classes can be used, without a node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.type_support import check_is_valid_msg_type
from rclpy.utilities import get_rmw_implementation_identifier

from router.errors import StartError
from router.ros.types import Definition, matching_class


def middleware() -> str:
    """`rmw_fastrtps_cpp`. Raises StartError where it cannot be loaded."""
    try:
        name: str = get_rmw_implementation_identifier()
    except RuntimeError as error:
        raise StartError(f"the middleware of ROS cannot be loaded: {error}") from error
    return name


def usable_class(type_name: str, definitions: Mapping[str, Definition]) -> Any:
    """The class, laid out as `definitions` say, with its type support loaded. Raises StartError."""
    message_class = matching_class(type_name, definitions)
    try:
        check_is_valid_msg_type(message_class)
    except Exception as error:  # a library that cannot be loaded, and whatever else a package brings
        raise StartError(f"{type_name} cannot be used: {error}") from error
    return message_class

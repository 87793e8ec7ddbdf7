"""ROS messages of any type, found by name and filled with plausible values."""

from __future__ import annotations

import importlib
import re
from typing import Any

ELEMENTS = 3
"""Elements in each sequence, unless its bound is lower."""

_SEQUENCE = re.compile(r"sequence<(?P<element>.+?)(, (?P<bound>\d+))?>")
_ARRAY = re.compile(r"(?P<element>.+)\[(?P<length>\d+)\]")


def message_class(name: str) -> Any:
    """Return the Python class of a type, for example of `sensor_msgs/msg/Imu`."""
    package, _, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), short)


def filled(kind: Any, number: int, stamp: object) -> Any:
    """Make a message of this class. Its numbers are derived from `number` and never zero; its times are `stamp`."""
    message = kind()
    for name, spelled in kind.get_fields_and_field_types().items():
        setattr(message, name, _value(spelled, number, stamp))
    return message


def _value(spelled: str, number: int, stamp: object) -> Any:
    """Make the value of a field; `spelled` is its type as rclpy names it."""
    if found := _SEQUENCE.fullmatch(spelled):
        return [_value(found["element"], number, stamp)] * min(ELEMENTS, int(found["bound"] or ELEMENTS))
    if found := _ARRAY.fullmatch(spelled):
        return [_value(found["element"], number, stamp)] * int(found["length"])
    if spelled == "builtin_interfaces/Time":
        return stamp
    if "/" in spelled:
        return filled(message_class(spelled.replace("/", "/msg/")), number, stamp)
    if spelled == "boolean":
        return number % 2 == 0
    if "string" in spelled:
        return "demo"
    value = 1 + number % 100  # fits every integer
    if spelled == "octet":
        return bytes([value])
    return float(value) if spelled in ("float", "double") else value

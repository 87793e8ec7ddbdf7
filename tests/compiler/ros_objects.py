"""rclpy's message objects from plain values and back, and their bytes. Imports nothing of ours.

As a program it answers one JSON request per line, for interfaces that only another process can load.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from rosidl_parser.definition import AbstractNestedType, BasicType, NamespacedType  # type: ignore[import-untyped]


def message_class(name: str) -> Any:
    package, kind, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), short)


def to_object(cls: Any, value: dict[str, Any]) -> Any:
    """A message with the fields in `value`; other fields keep the constructor's defaults."""
    made = cls()
    for name, index in zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True):
        if name in value:
            setattr(made, name, _to_slot(index, value[name]))
    return made


def _to_slot(index: Any, value: Any) -> Any:
    if isinstance(index, AbstractNestedType):
        return [_to_slot(index.value_type, element) for element in value]
    if isinstance(index, NamespacedType):
        return to_object(message_class("/".join(index.namespaced_name())), value)
    if isinstance(index, BasicType) and index.typename == "octet":
        return bytes([value])
    return value


def to_value(message: Any) -> dict[str, Any]:
    names = message.get_fields_and_field_types()
    return {
        name: _from_slot(index, getattr(message, name)) for name, index in zip(names, message.SLOT_TYPES, strict=True)
    }


def _from_slot(index: Any, value: Any) -> Any:
    if isinstance(index, AbstractNestedType):
        elements = value.tolist() if hasattr(value, "tolist") else value
        return [_from_slot(index.value_type, element) for element in elements]
    if isinstance(index, NamespacedType):
        return to_value(value)
    return value[0] if isinstance(value, bytes) else value


def serialized(name: str, value: dict[str, Any]) -> bytes:
    return bytes(serialize_message(to_object(message_class(name), value)))


def deserialized(name: str, data: bytes) -> dict[str, Any]:
    return to_value(deserialize_message(data, message_class(name)))


def main() -> None:
    for line in sys.stdin:
        name, value, data = json.loads(line)
        answer = {"data": serialized(name, value).hex(), "value": deserialized(name, bytes.fromhex(data))}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()

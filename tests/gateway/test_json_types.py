"""Schemas are those of the existing gateway."""

from __future__ import annotations

import json

import pytest

from router.gateway.json_types import schema_text
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.ros import RosInterfaces, ros_interfaces


@pytest.fixture(scope="module")
def interfaces() -> RosInterfaces:
    return ros_interfaces()


def field(declared: Type) -> dict[str, object]:
    schema = json.loads(schema_text(MessageType("made/msg/Made", (Field("it", declared),))))
    found: dict[str, object] = schema["fields"][0]
    return found


def test_keys_are_sorted_and_fields_are_not(interfaces: RosInterfaces) -> None:
    quaternion = interfaces.get("geometry_msgs/msg/Quaternion")
    assert quaternion is not None
    fields = ",".join(f'{{"is_array":false,"name":"{name}","subtype":"primitive","type":"float64"}}' for name in "xyzw")
    assert schema_text(quaternion) == f'{{"fields":[{fields}],"name":"Quaternion","namespace":"geometry_msgs::msg"}}'


@pytest.mark.parametrize(
    ("declared", "name"),
    [
        (Bool(), "bool"), (Int(8, signed=False, octet=True), "byte"), (Int(8, signed=False), "uint8"),
        (Int(8, signed=True), "int8"), (Int(64, signed=False), "uint64"), (Float(32), "float32"),
        (Float(64), "float64"), (String(), "string"), (String(5), "string"), (String(wide=True), "wstring"),
        (String(5, wide=True), "wstring"),
    ],
)  # fmt: skip
def test_scalar_is_named_without_its_bound(declared: Type, name: str) -> None:
    assert field(declared) == {"name": "it", "is_array": False, "type": name, "subtype": "primitive"}


@pytest.mark.parametrize("size", [{}, {"length": 3}, {"bound": 3}])
def test_every_kind_of_list_is_an_array(size: dict[str, int]) -> None:
    assert field(List(Float(64), **size)) == {"name": "it", "is_array": True, "type": "float64", "subtype": "primitive"}


def test_ros_char_is_what_rosidl_makes_of_it(interfaces: RosInterfaces) -> None:
    for name, expected in (("Char", "uint8"), ("Byte", "byte")):
        message = interfaces.get(f"std_msgs/msg/{name}")
        assert message is not None
        assert json.loads(schema_text(message))["fields"][0]["type"] == expected


def test_nested_schema_is_the_subtype(interfaces: RosInterfaces) -> None:
    header, transforms = interfaces.get("std_msgs/msg/Header"), interfaces.get("tf2_msgs/msg/TFMessage")
    assert header is not None
    assert transforms is not None
    (many,) = json.loads(schema_text(transforms))["fields"]
    assert (many["type"], many["is_array"]) == ("message", True)
    assert many["subtype"]["fields"][0]["subtype"] == json.loads(schema_text(header))


def test_message_without_fields_has_the_one_that_rosidl_gives_it() -> None:
    assert schema_text(MessageType("std_msgs/msg/Empty")) == (
        '{"fields":[{"is_array":false,"name":"structure_needs_at_least_one_member","subtype":"primitive",'
        '"type":"uint8"}],"name":"Empty","namespace":"std_msgs::msg"}'
    )

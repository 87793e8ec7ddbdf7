"""Types as installed classes describe them are those that their definitions declare."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rosidl_parser.definition import (  # type: ignore[import-untyped]
    Array,
    BasicType,
    BoundedSequence,
    BoundedString,
    BoundedWString,
    NamespacedType,
    UnboundedSequence,
    UnboundedString,
    UnboundedWString,
)

from router.compiler.lookup import layout
from router.errors import StartError
from router.ros import types as ros_types
from router.ros.types import installed_class, installed_type, matching_class
from router.types.model import Bool, Float, Int, List, MessageType, String, Type
from router.types.ros import RosInterfaces, ros_interfaces


def is_installed(name: str) -> bool:
    package, _, short = name.partition("/msg/")
    return find_spec(package) is not None and hasattr(__import__(f"{package}.msg").msg, short)


def generated(**slots: object) -> SimpleNamespace:
    """What stands for a class with these slots. How it spells them does not matter."""
    return SimpleNamespace(
        get_fields_and_field_types=lambda: dict.fromkeys(slots, ""), SLOT_TYPES=tuple(slots.values())
    )


def shape(declared: object) -> object:
    """The type with all that is in it, to be compared."""
    match declared:
        case MessageType():
            return declared.name, [(field.name, shape(field.type)) for field in declared.fields]
        case List():
            return shape(declared.element), declared.length, declared.bound
        case _:
            return declared


@pytest.fixture(scope="module")
def interfaces() -> RosInterfaces:
    return ros_interfaces()


@pytest.mark.parametrize("name", sorted(filter(is_installed, ros_interfaces().names())))
def test_a_class_describes_what_its_msg_file_declares(interfaces: RosInterfaces, name: str) -> None:
    declared, described = interfaces.get(name), installed_type(name)
    assert declared
    assert shape(described) == shape(declared)
    assert layout(described) == layout(declared)


def test_what_belongs_to_a_service_is_named_so_and_its_class_matches() -> None:
    event = installed_type("type_description_interfaces/srv/GetTypeDescription_Event")
    _, request, _ = event.fields
    assert (request.name, shape(request.type)) == (
        "request",
        (
            (
                "type_description_interfaces/srv/GetTypeDescription_Request",
                [("type_name", String()), ("type_hash", String()), ("include_type_sources", Bool())],
            ),
            None,
            1,
        ),
    )
    assert matching_class(event.name, layout(event)) is installed_class(event.name)


def test_a_request_without_fields_has_none() -> None:
    assert installed_type("lifecycle_msgs/srv/GetState_Request").fields == ()


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (BasicType("boolean"), Bool()),
        (BasicType("octet"), Int(8, signed=False, octet=True)),
        (BasicType("uint8"), Int(8, signed=False)),
        (BasicType("int64"), Int(64, signed=True)),
        (BasicType("float"), Float(32)),
        (BasicType("double"), Float(64)),
        (UnboundedString(), String()),
        (BoundedString(5), String(5)),
        (UnboundedWString(), String(wide=True)),
        (BoundedWString(5), String(5, wide=True)),
        (Array(BasicType("double"), 36), List(Float(64), length=36)),
        (UnboundedSequence(BoundedString(3)), List(String(3))),
        (BoundedSequence(UnboundedWString(), 4), List(String(wide=True), bound=4)),
    ],
)
def test_every_kind_of_slot_is_known(monkeypatch: pytest.MonkeyPatch, index: object, expected: Type) -> None:
    monkeypatch.setattr(ros_types, "installed_class", lambda _: generated(it=index))
    assert shape(installed_type("made_msgs/msg/Made")) == ("made_msgs/msg/Made", [("it", shape(expected))])


def test_types_in_an_action_keep_their_namespace_and_are_one_each(monkeypatch: pytest.MonkeyPatch) -> None:
    inner = NamespacedType(["made_msgs", "action"], "Wait_Feedback")
    classes = {
        "made_msgs/action/Wait_FeedbackMessage": generated(one=inner, many=UnboundedSequence(inner)),
        "made_msgs/action/Wait_Feedback": generated(left=BasicType("float")),
    }
    monkeypatch.setattr(ros_types, "installed_class", classes.__getitem__)
    one, many = installed_type("made_msgs/action/Wait_FeedbackMessage").fields
    assert shape(one.type) == ("made_msgs/action/Wait_Feedback", [("left", Float(32))])
    assert isinstance(many.type, List)
    assert many.type.element is one.type


@pytest.mark.parametrize("unknown", ["wchar", "long double", "char"])
def test_a_type_that_only_idl_has_is_refused_with_its_place(monkeypatch: pytest.MonkeyPatch, unknown: str) -> None:
    index = UnboundedSequence(BasicType(unknown))
    monkeypatch.setattr(ros_types, "installed_class", lambda _: generated(it=index))
    with pytest.raises(StartError, match=f"^made_msgs/msg/Made.it is a {unknown}, which the router cannot read"):
        installed_type("made_msgs/msg/Made")


def test_a_type_that_is_not_installed_is_refused() -> None:
    with pytest.raises(StartError, match="std_msgs/msg/NoSuch is not installed"):
        installed_type("std_msgs/msg/NoSuch")

"""Installed message types without their Python classes, which a router that handles CDR never uses.

A message class imports all classes of its package and of the packages that this uses, often also NumPy: 0.1 s and
25 MB for a rover. The C library of a package has all that rcl needs, and descriptions of the types.
"""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from router.ros.rcl import RCL

Definition = tuple[tuple[str, str], ...]
"""The fields of a type: names, and types in rclpy's notation."""

_MEMBERS = ("create_ros_message", "convert_from_py", "convert_to_py", "destroy_ros_message", "type_support")
"""The attributes that rclpy expects of the metaclass of a message, in capital letters."""

_NESTED, _BOUNDED = 1, {21: "string", 22: "wstring"}
_ARRAY, _BOUNDED_SEQUENCE, _SEQUENCE, _LISTS_END = 48, 96, 144, 192
_SIMPLE = dict(
    enumerate(["int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float", "double"], 2)
) | {15: "boolean", 16: "octet", 17: "string", 18: "wstring"}
"""FIELD_TYPE_... of type_description_interfaces/msg/FieldType; for lists, one of the bases above is added."""

_OF_EMPTY = "structure_needs_at_least_one_member"
"""The field of a type without fields, which neither `.msg` files nor rclpy show."""


class _Text(ctypes.Structure):
    """rosidl_runtime_c__String."""

    _fields_ = (("data", ctypes.c_char_p), ("size", ctypes.c_size_t), ("capacity", ctypes.c_size_t))

    def __str__(self) -> str:
        return str((self.data or b"").decode())


class _FieldType(ctypes.Structure):
    _fields_ = (
        ("id", ctypes.c_uint8),
        ("capacity", ctypes.c_uint64),
        ("string_capacity", ctypes.c_uint64),
        ("nested", _Text),
    )


class _Field(ctypes.Structure):
    _fields_ = (("name", _Text), ("type", _FieldType), ("default", _Text))


class _Fields(ctypes.Structure):
    _fields_ = (("data", ctypes.POINTER(_Field)), ("size", ctypes.c_size_t), ("capacity", ctypes.c_size_t))


class _Type(ctypes.Structure):
    """IndividualTypeDescription."""

    _fields_ = (("name", _Text), ("fields", _Fields))


class _Types(ctypes.Structure):
    _fields_ = (("data", ctypes.POINTER(_Type)), ("size", ctypes.c_size_t), ("capacity", ctypes.c_size_t))


class _Description(ctypes.Structure):
    """TypeDescription."""

    _fields_ = (("type", _Type), ("referenced", _Types))


class _TypeSupport(ctypes.Structure):
    """rosidl_message_type_support_t."""

    _fields_ = (
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("handle", ctypes.c_void_p),
        ("hash", ctypes.c_void_p),
        ("description", ctypes.CFUNCTYPE(ctypes.POINTER(_Description), ctypes.c_void_p)),
    )


_capsule_name = ctypes.pythonapi.PyCapsule_GetName
_capsule_name.argtypes, _capsule_name.restype = (ctypes.py_object,), ctypes.c_char_p
_capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_capsule_pointer.argtypes, _capsule_pointer.restype = (ctypes.py_object, ctypes.c_char_p), ctypes.c_void_p


def class_for_cdr(package: str, kind: str, short: str, definitions: Mapping[str, Definition]) -> Any:
    """Return a stand-in for a message class, with which rclpy publishes and takes the type as CDR.

    None unless the type and its nested types are installed as in `definitions`. Imports only the C library.
    """
    if not hasattr(RCL, "rcl_node_type_description_service_init"):  # a release whose types do not describe themselves
        return None
    name = f"{package}/{kind}/{short}"
    try:
        from rosidl_generator_py import import_type_support  # type: ignore[import-untyped]

        library = import_type_support(package)
        members = {
            f"_{member.upper()}": getattr(library, f"{member}_msg__{kind}__{_snake_case(short)}") for member in _MEMBERS
        }
    except Exception:  # noqa: BLE001 the import of the class will report the error in more detail
        return None
    if not definitions.items() <= dict(_described(members["_TYPE_SUPPORT"])).items():
        return None
    metaclass = type(f"Metaclass_{short}", (type,), members)
    return metaclass(short, (), {"__module__": f"{package}.{kind}", "__doc__": f"Stands for {name}."})


class _Place(ctypes.Structure):
    """Dl_info."""

    _fields_ = (
        ("library", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("symbol", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


def library_of(message_class: Any) -> Path | None:
    """Return the C library that describes a loaded type; None if none does."""
    capsule = message_class.__class__._TYPE_SUPPORT
    describe = _TypeSupport.from_address(_capsule_pointer(capsule, _capsule_name(capsule))).description
    place = _Place()
    if not describe or not ctypes.CDLL(None).dladdr(ctypes.cast(describe, ctypes.c_void_p), ctypes.byref(place)):
        return None
    return Path(os.fsdecode(place.library))


def _snake_case(name: str) -> str:
    """Return the name in rosidl's snake case, as in its file names."""
    words = re.sub("(.)([A-Z][a-z]+)", r"\1_\2", name)
    return re.sub("([a-z0-9])([A-Z])", r"\1_\2", words).lower()


def _described(capsule: object) -> Iterator[tuple[str, Definition]]:
    """Yield the definitions of the type and its nested types, by name; nothing if it has no description."""
    address = _capsule_pointer(capsule, _capsule_name(capsule))
    describe = _TypeSupport.from_address(address).description
    if not describe:
        return
    description = describe(address).contents
    for described in (description.type, *description.referenced.data[: description.referenced.size]):
        fields = [(str(field.name), _spelled(field.type)) for field in described.fields.data[: described.fields.size]]
        yield str(described.name), tuple(field for field in fields if field[0] != _OF_EMPTY)


def _spelled(declared: _FieldType) -> str:
    """Return the type of a field in rclpy's notation; "unknown" if no `.msg` file can declare it."""
    base = (declared.id - 1) // _ARRAY * _ARRAY if declared.id <= _LISTS_END else _LISTS_END
    kind = declared.id - base
    if kind == _NESTED:
        package, _, rest = str(declared.nested).partition("/")
        element = f"{package}/{rest.rpartition('/')[2]}"
    elif kind in _BOUNDED:
        element = f"{_BOUNDED[kind]}<{declared.string_capacity}>"
    else:
        element = _SIMPLE.get(kind, "unknown")
    return {
        0: element,
        _ARRAY: f"{element}[{declared.capacity}]",
        _BOUNDED_SEQUENCE: f"sequence<{element}, {declared.capacity}>",
        _SEQUENCE: f"sequence<{element}>",
    }.get(base, "unknown")

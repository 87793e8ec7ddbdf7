"""The rcl library that rclpy has loaded: functions that are called without rclpy, and a check of their structures."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char, c_char_p, c_int, c_size_t, c_void_p
from typing import Any, NamedTuple

from rclpy.impl.implementation_singleton import rclpy_implementation

RCL = ctypes.CDLL(rclpy_implementation.__file__)
"""Calls through ctypes release the interpreter lock; those of rclpy hold it."""


class Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = tuple((name, c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state"))


class SerializedMessage(ctypes.Structure):
    """rcutils_uint8_array_t. The allocator stays zero if the bytes are only read."""

    _fields_ = (
        ("buffer", c_char_p),
        ("length", c_size_t),
        ("capacity", c_size_t),
        ("allocator", Allocator),
    )


class ErrorString(ctypes.Structure):
    """rcutils_error_string_t."""

    _fields_ = (("text", c_char * 1024),)


def address(name: str) -> int:
    """Return the address of a function."""
    return ctypes.cast(getattr(RCL, name), c_void_p).value or 0


def function(name: str, returned: Any, *taken: Any) -> Any:
    """Return a function with its types, not shared with other callers."""
    return ctypes.CFUNCTYPE(returned, *taken)((name, RCL))


def callback_setter(name: str) -> Any:
    """Return a function of rcl that sets who is called for new messages: (handle, callback, user data)."""
    return function(name, c_int, c_void_p, c_void_p, c_void_p)


class PublishFunctions(NamedTuple):
    """Addresses of the functions that publish CDR bytes, return the error, and reset it."""

    publish: int
    error: int
    reset: int


def publish_functions() -> PublishFunctions | None:
    """Return the addresses; None if rcl lacks a function or its structures differ: then publish only through rclpy."""
    names = "rcl_publish_serialized_message", "rcutils_get_error_string", "rcutils_reset_error"
    try:
        return PublishFunctions(*map(address, names)) if _fills_messages_as_declared() else None
    except AttributeError:  # no such function
        return None


def _fills_messages_as_declared() -> bool:
    """Return whether rcl initializes a message with exactly the layout of SerializedMessage."""
    capacity, behind = 1234, b"\xa5" * 64
    default = function("rcutils_get_default_allocator", Allocator)()
    opened = function("rcutils_uint8_array_init", c_int, c_void_p, c_size_t, POINTER(Allocator))
    closed = function("rcutils_uint8_array_fini", c_int, c_void_p)
    memory = ctypes.create_string_buffer(bytes(ctypes.sizeof(SerializedMessage)) + behind)
    message = SerializedMessage.from_buffer(memory)
    if opened(memory, capacity, default):
        return False
    is_as_declared = (
        bool(c_void_p.from_buffer(memory).value)
        and (message.length, message.capacity) == (0, capacity)
        and bytes(message.allocator) == bytes(default)
        and memory.raw.endswith(behind + b"\0")
    )
    return is_as_declared and closed(memory) == 0

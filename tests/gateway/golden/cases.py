"""The messages of which packets are captured: chosen ones, and one of random values for each installed type.

Knows ROS's Python messages, neither gateway nor router.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ament_index_python import get_package_share_directory
from rosidl_parser.definition import (  # type: ignore[import-untyped]
    AbstractNestedType,
    AbstractString,
    AbstractWString,
    Array,
    BasicType,
    NamespacedType,
)

from tests.compiler.interface_package import NAME
from tests.compiler.ros_objects import message_class, serialized

PACKAGES = ("builtin_interfaces", "comms", "geometry_msgs", "rcl_interfaces", "sensor_msgs", "std_msgs", NAME)
SEED = 5

NAN, INF = float("nan"), float("inf")
DOUBLES = (
    0.0, -0.0, 1.0, -1.5, 0.1, 0.3, 1 / 3, 100.0, 123456789.125, 1e-4, 1e-5, 1.5e-7, 1e14, 1e15, 1e16, 1.5e16, 1e17,
    1e21, 1e22, 1e23, 9007199254740993.0, 2.0**63, 5e-324, 1e-323, 2.2250738585072009e-308, 2.2250738585072014e-308,
    1.7976931348623157e308, -1.7976931348623157e308, NAN, INF, -INF, 3.141592653589793, 5e-5, 4.35, 0.000123,
    9.5367431640625e-07, 2.5e100, 1e100, 999999999999999.9, 99999999999999990.0,
)  # fmt: skip
FLOATS = (
    0.0, -0.0, 1.0, 0.1, -0.3, 1e-45, 1.1754942e-38, 1.17549435e-38, 3.4028235e38, -3.4028235e38, NAN, INF, -INF,
    16777216.0, 33554432.0, 1e10, 1e-10, 3.1415927, 0.001,
)  # fmt: skip
TEXTS = (
    "", "base_link", "it's \"quoted\" \\ and / with slash", "tab\tline\nreturn\r\b\f", "\x01\x02\x1b\x1f\x7f",
    "grüße aus 東京", "😀🚀", "\u2028\u2029\ufeff\ufffd\uffff", "</script>&amp;", " " * 3,
)  # fmt: skip
WIDE_TEXTS = ("", "wide", "\x01grüße 東京", "😀", "\uffff\ufeff")


class Case(NamedTuple):
    """`cdr` with its encapsulation, as it is published."""

    name: str
    type_name: str
    cdr: bytes


def _cdr(body: bytes) -> bytes:
    return b"\0\1\0\0" + body


def _string(text: bytes) -> bytes:
    """A std_msgs/msg/String, of which rclpy would not make every one."""
    return _cdr(struct.pack("<I", len(text)) + text)


def _arrays(kind: str, values: Sequence[Any]) -> bytes:
    return serialized(f"std_msgs/msg/{kind}MultiArray", {"data": list(values)})


def _patterns(count: int, format_: str) -> list[float]:
    """Numbers of random bits, all of them finite."""
    bits = random.Random(SEED)
    found: list[float] = []
    while len(found) < count:
        (value,) = struct.unpack(format_, bits.randbytes(struct.calcsize(format_)))
        found += [value] if abs(value) < INF else []
    return found


def _decimals(count: int) -> list[float]:
    """Numbers as sensors give them, of few digits and of any size."""
    choose = random.Random(SEED)
    return [round(choose.uniform(-1, 1) * 10 ** choose.randint(-6, 18), choose.randint(0, 9)) for _ in range(count)]


def _wholes(bits: int, is_signed: bool) -> list[int]:
    lowest = -(1 << (bits - 1)) if is_signed else 0
    highest = lowest + (1 << bits) - 1
    return [lowest, lowest + 1, 0, 1, 10, 99, 100, highest - 1, highest]


def chosen() -> Iterator[Case]:
    """Those that one would not meet by chance."""
    text = "std_msgs/msg/String"
    for number, value in enumerate(TEXTS):
        yield Case(f"text_{number}", text, serialized(text, {"data": value}))
    every = "".join(map(chr, range(1, 0x180)))
    yield Case("text_every", text, serialized(text, {"data": every}))
    yield Case("text_long", text, serialized(text, {"data": "grüße " * 2000}))
    yield Case("text_with_nul", text, _string(b"before\0after\0"))
    yield Case("text_only_nul", text, _string(b"\0\0"))
    yield Case("text_of_length_0", text, _string(b""))
    yield Case("text_unended", text, _string(b"abc"))
    yield Case("text_no_utf8", text, _string(b"\xff\xfe\0"))
    yield Case("text_overlong", text, _string(b"\xc0\x80\0"))
    yield Case("text_surrogate", text, _string(b"\xed\xa0\x80\0"))
    yield Case("text_cut_utf8", text, _string(b"ab\xe6\x9d\0"))
    yield Case("text_too_short", text, _cdr(struct.pack("<I", 100) + b"abc\0"))
    yield Case("text_and_more", text, _string(b"abc\0") + b"\0\1\2\3")
    yield Case("nothing", "std_msgs/msg/Empty", serialized("std_msgs/msg/Empty", {}))
    yield Case("doubles", "std_msgs/msg/Float64MultiArray", _arrays("Float64", DOUBLES))
    yield Case("doubles_bits", "std_msgs/msg/Float64MultiArray", _arrays("Float64", _patterns(1500, "<d")))
    yield Case("doubles_decimal", "std_msgs/msg/Float64MultiArray", _arrays("Float64", _decimals(1500)))
    yield Case("doubles_none", "std_msgs/msg/Float64MultiArray", _arrays("Float64", ()))
    yield Case("floats", "std_msgs/msg/Float32MultiArray", _arrays("Float32", FLOATS))
    yield Case("floats_bits", "std_msgs/msg/Float32MultiArray", _arrays("Float32", _patterns(1000, "<f")))
    for bits in (8, 16, 32, 64):
        for kind, is_signed in ((f"Int{bits}", True), (f"UInt{bits}", False)):
            yield Case(kind.lower(), f"std_msgs/msg/{kind}MultiArray", _arrays(kind, _wholes(bits, is_signed)))
    yield Case("bytes", "std_msgs/msg/ByteMultiArray", _arrays("Byte", range(256)))
    yield Case("bytes_long", "std_msgs/msg/UInt8MultiArray", _arrays("UInt8", [n % 251 for n in range(9000)]))
    wide = f"{NAME}/msg/WideText"
    for number, value in enumerate(WIDE_TEXTS):
        yield Case(f"wide_{number}", wide, serialized(wide, {"text": value, "many": list(WIDE_TEXTS)}))
    flags = f"{NAME}/msg/SmallArrays"
    yield Case("flags", flags, serialized(flags, {"yes": [True, False, True], "flags": [True, False] * 9}))


def _types() -> Iterator[str]:
    for package in PACKAGES:
        folder = Path(get_package_share_directory(package), "msg")
        yield from (f"{package}/msg/{path.stem}" for path in sorted(folder.glob("*.msg")))


def _random_scalar(slot: Any, choose: random.Random) -> Any:
    if isinstance(slot, AbstractWString):
        return choose.choice(WIDE_TEXTS)[: getattr(slot, "maximum_size", None)]
    if isinstance(slot, AbstractString):
        bound = getattr(slot, "maximum_size", None)
        return choose.choice(TEXTS) if bound is None else 'ab"\n\x01cdef'[: choose.randint(0, bound)]
    assert isinstance(slot, BasicType)
    kind = slot.typename
    if kind == "boolean":
        return choose.random() < 0.5
    if kind == "double":
        return choose.choice((*DOUBLES, choose.uniform(-10, 10), choose.gauss(0, 1e-3)))
    if kind == "float":
        return choose.choice(FLOATS)
    if kind == "octet":
        return choose.randint(0, 255)
    return choose.choice(_wholes(int(kind.lstrip("uint")), is_signed=not kind.startswith("u")))


def _random_slot(slot: Any, choose: random.Random) -> Any:
    if isinstance(slot, AbstractNestedType):
        count = slot.size if isinstance(slot, Array) else choose.randint(0, 3)
        return [_random_slot(slot.value_type, choose) for _ in range(min(count, getattr(slot, "maximum_size", count)))]
    if isinstance(slot, NamespacedType):
        return _random_value("/".join(slot.namespaced_name()), choose)
    return _random_scalar(slot, choose)


def _random_value(type_name: str, choose: random.Random) -> dict[str, Any]:
    cls = message_class(type_name)
    slots = zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True)
    return {name: _random_slot(slot, choose) for name, slot in slots}


def of_every_type() -> Iterator[Case]:
    """Two for each: all fields at their defaults, and random values that are the same each time."""
    for type_name in _types():
        label = type_name.replace("/msg/", "__")
        yield Case(f"default__{label}", type_name, serialized(type_name, {}))
        value = _random_value(type_name, random.Random(f"{SEED} {type_name}"))
        yield Case(f"random__{label}", type_name, serialized(type_name, value))

"""One type model for protobuf messages and ROS interfaces. `types.protobuf` and `types.ros` build it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Union


@dataclass(frozen=True, slots=True)
class Bool:
    def __str__(self) -> str:
        return "bool"


@dataclass(frozen=True, slots=True)
class Int:
    """A two's complement integer of 8, 16, 32 or 64 bits.

    `octet` marks ROS's `byte`, which differs from a uint8 only in how rclpy spells its type.
    """

    bits: int
    signed: bool
    octet: bool = field(default=False, compare=False)

    @property
    def low(self) -> int:
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def high(self) -> int:
        return (1 << (self.bits - self.signed)) - 1

    def __str__(self) -> str:
        return f"{'' if self.signed else 'u'}int{self.bits}"


@dataclass(frozen=True, slots=True)
class Float:
    """IEEE 754, 32 or 64 bits."""

    bits: int

    def __str__(self) -> str:
        return f"float{self.bits}"


@dataclass(frozen=True, slots=True)
class String:
    """Text. `bound` is the largest length (ROS: bytes without the final NUL), None for unbounded."""

    bound: int | None = None
    wide: bool = False

    def __str__(self) -> str:
        return ("wstring" if self.wide else "string") + (f"<={self.bound}" if self.bound is not None else "")


@dataclass(frozen=True, slots=True)
class Bytes:
    """A protobuf `bytes` field of at most `bound` bytes, None for unbounded."""

    bound: int | None = None

    def __str__(self) -> str:
        return "bytes" + (f"<={self.bound}" if self.bound is not None else "")


@dataclass(frozen=True, slots=True)
class Enum:
    """A protobuf enum with its named `values`. A value may be any int32, unless the enum `is_closed` (proto2)."""

    name: str
    values: tuple[tuple[str, int], ...]
    is_closed: bool = False

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class List:
    """A list of exactly `length` elements (a ROS array), at most `bound`, or any number."""

    element: Type
    length: int | None = None
    bound: int | None = None

    @property
    def entry(self) -> MessageType | None:
        """The type of an entry of a protobuf map, with its key and its value; None for other lists."""
        return self.element if isinstance(self.element, MessageType) and self.element.is_map_entry else None

    @property
    def content(self) -> Type:
        """The type of an element; of a value in a protobuf map."""
        return self.element if self.entry is None else self.entry.fields[1].type

    def __str__(self) -> str:
        size = str(self.length) if self.length is not None else f"<={self.bound}" if self.bound is not None else ""
        return f"{self.element}[{size}]"


@dataclass(frozen=True, slots=True)
class Field:
    """One member of a message.

    `number` is the protobuf field number (0 for ROS). With `has_presence`, "not set" differs from the default; a field
    that `is_required` must be set (proto2, and both parts of a map entry). `oneof` is the field's protobuf oneof; an
    optional field may have its own. Text that `is_unchecked` may not be UTF-8, as in proto2: protobuf then returns
    bytes. A message that `is_group` is encoded between two tags, without a length. `default` is a ROS field's declared
    default, None for the type's zero. `comment` is its documentation, as one line.
    """

    name: str
    type: Type
    number: int = 0
    has_presence: bool = False
    is_required: bool = False
    oneof: str | None = None
    default: object = None
    comment: str = ""
    is_unchecked: bool = False
    is_group: bool = False


@dataclass(eq=False, slots=True)
class MessageType:
    """A protobuf message (`SensorBoardIMUInfo`) or a ROS one (`sensor_msgs/msg/Imu`).

    Compared by identity: a name has one MessageType per schema. Fields keep their declared order, which determines the
    encoding in ROS. Protobuf messages may contain themselves, so the code that builds the type fills `fields` once,
    afterwards. A list of a type that `is_map_entry` is a protobuf map.
    """

    name: str
    fields: tuple[Field, ...] = ()
    constants: Mapping[str, object] = field(default_factory=dict)
    is_map_entry: bool = False

    def field(self, name: str) -> Field | None:
        return next((member for member in self.fields if member.name == name), None)

    @property
    def names(self) -> list[str]:
        """The names of the fields that a table can write, without those that the router adds: `(number)`."""
        return [member.name for member in self.fields if not member.name.startswith("(")]

    @property
    def short_name(self) -> str:
        """`Imu` of `sensor_msgs/msg/Imu`; `State` of `MotorInformation.State`."""
        return self.name.replace("/", ".").rpartition(".")[2]

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        return f"MessageType({self.name!r}, {len(self.fields)} fields)"


def snake_case(name: str) -> str:
    """Return `radiation_info` for `RadiationInfo`."""
    return _WORD_BORDER.sub("_", name).lower()


_WORD_BORDER = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


Type = Union[Bool, Int, Float, String, Bytes, Enum, List, MessageType]

_ZEROS: Mapping[type, object] = {Bool: False, Int: 0, Float: 0.0, String: "", Bytes: b""}


def zero(kind: Type) -> object:
    """Return the value of a scalar that is not set; of an enum, its first value."""
    return kind.values[0][1] if isinstance(kind, Enum) else _ZEROS[type(kind)]


def default_of(kind: Type, declared: object = None) -> Any:
    """Return the value of an unset field, whose declared default may be given; of a message, its values by name."""
    if declared is not None:
        return declared
    match kind:
        case MessageType():
            return {field.name: default_of(field.type, field.default) for field in kind.fields}
        case List():
            return [default_of(kind.element) for _ in range(kind.length or 0)]
    return zero(kind)

"""The oracle's second half: a ROS message as CDR bytes, one scalar after the other.

Plain CDR, little-endian, as rmw_fastrtps writes it. Knows values and types only; see `reference`.
"""

from __future__ import annotations

import struct
from typing import Any

from router.compiler.reference import Value
from router.types.model import Bool, Float, Int, List, MessageType, String, Type


def cdr(message: MessageType, value: dict[str, Value], padding: int = 0) -> bytes:
    """The bytes of a message with their header. Bytes between values mean nothing and are `padding`."""
    writer = _Writer(padding)
    writer.write(message, value)
    return b"\x00\x01\x00\x00" + bytes(writer.data)


class _Writer:
    def __init__(self, padding: int) -> None:
        self.padding = padding
        self.data = bytearray()

    def scalar(self, format_: str, value: object) -> None:
        """Aligned to its own size, counted from behind the header."""
        packed = struct.pack("<" + format_, value)
        while len(self.data) % len(packed):
            self.data.append(self.padding)
        self.data += packed

    def write(self, declared: Type, value: Any) -> None:  # noqa: C901, PLR0912 - a case a type
        match declared:
            case MessageType():
                for field in declared.fields:
                    self.write(field.type, value[field.name])
                if not declared.fields:
                    self.scalar("B", 0)  # what ROS puts into a message without fields
            case List():
                if declared.length is None:
                    self.scalar("I", len(value))
                for element in value:
                    self.write(declared.element, element)
            case String(wide=True):
                units = value.encode("utf-16-le")
                self.scalar("I", len(units) // 2)
                for (unit,) in struct.iter_unpack("<H", units):
                    self.scalar("I", unit)
            case String():
                text = value.encode() + b"\0"
                self.scalar("I", len(text))
                self.data += text
            case Bool():
                self.scalar("B", int(value))
            case Int():
                letter = {8: "b", 16: "h", 32: "i", 64: "q"}[declared.bits]
                self.scalar(letter if declared.signed else letter.upper(), value)
            case Float():
                self.scalar("f" if declared.bits == 32 else "d", value)
            case _:
                raise TypeError(f"ROS has no type {declared}")

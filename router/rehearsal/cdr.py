"""ROS messages to CDR bytes and back, one scalar after the other: slow, plain, and independent of the carrier.

Plain CDR, little-endian, as rmw_fastrtps writes it. This code checks what the carrier writes, in table tests and as the
oracle of the router's own tests.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

from router.errors import MappingError
from router.types.model import Bool, Float, Int, List, MessageType, String, Type


def serialize(message: MessageType, values: Mapping[str, Any], padding: int = 0) -> bytes:
    """Return a message as CDR with its header, from all its values by name. Gaps for alignment are `padding`."""
    writer = _Writer(padding)
    writer.write(message, values)
    return b"\x00\x01\x00\x00" + bytes(writer.data)


def deserialize(message: MessageType, data: bytes) -> SimpleNamespace:
    """Decode a CDR message with its header to nested objects; lists of bytes become lists of numbers.

    Bytes after the message are ignored. Raises MappingError or ValueError if the bytes are not such a message.
    """
    if data[:2] != b"\x00\x01":
        raise MappingError(f"not plain CDR: {data[:2].hex()}")
    parsed: SimpleNamespace = _Reader(data[4:]).read(message)
    return parsed


class _Writer:
    def __init__(self, padding: int) -> None:
        self.padding = padding
        self.data = bytearray()

    def scalar(self, format_: str, value: object) -> None:
        """Append a scalar, aligned to its own size, relative to the end of the header."""
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
                    self.scalar("B", 0)  # ROS puts this into a message without fields
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


class _Reader:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def bytes(self, count: int) -> bytes:
        if self.at + count > len(self.data):
            raise MappingError(f"{len(self.data)} bytes, but {count} are needed from {self.at} on")
        self.at += count
        return self.data[self.at - count : self.at]

    def scalar(self, format_: str) -> Any:
        size = struct.calcsize("<" + format_)
        while self.at % size:
            self.at += 1
        return struct.unpack("<" + format_, self.bytes(size))[0]

    def read(self, declared: Type) -> Any:  # noqa: C901 - a case a type
        match declared:
            case MessageType():
                read = SimpleNamespace(**{field.name: self.read(field.type) for field in declared.fields})
                if not declared.fields:
                    self.scalar("B")
                return read
            case List():
                length = self.scalar("I") if declared.length is None else declared.length
                return [self.read(declared.element) for _ in range(length)]
            case String(wide=True):
                units = [self.scalar("I") for _ in range(self.scalar("I"))]
                if any(unit > 0xFFFF for unit in units):
                    raise MappingError("no UTF-16")
                return b"".join(unit.to_bytes(2, "little") for unit in units).decode("utf-16-le")
            case String():
                text = self.bytes(self.scalar("I"))
                if not text:
                    return ""
                if text[-1:] != b"\0":
                    raise MappingError("a string without its NUL")
                return text[:-1].decode()
            case Bool():
                return self.scalar("B") != 0
            case Int():
                letter = {8: "b", 16: "h", 32: "i", 64: "q"}[declared.bits]
                return self.scalar(letter if declared.signed else letter.upper())
            case Float():
                return self.scalar("f" if declared.bits == 32 else "d")
            case _:
                raise TypeError(f"ROS has no type {declared}")

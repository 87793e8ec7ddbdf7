"""Cuts what comes in from a TCP client into packets or lines. Pure: knows no socket and nothing of what they say."""

from __future__ import annotations

import struct
from typing import Protocol

LENGTH = struct.Struct("<I")
"""What precedes each packet."""


class TooLongError(ValueError):
    """A packet or line is longer than may be; where the next one begins cannot be told."""


class Splitter(Protocol):
    """`most` bounds what it keeps, and what it gives, in bytes."""

    def feed(self, data: memoryview) -> None: ...

    def take(self) -> bytes | None:
        """The next one that is complete. Raises TooLongError."""

    def __len__(self) -> int:
        """How many bytes it keeps."""

    def clear(self) -> None: ...


class Packets:
    """Each preceded by its length, u32 little-endian."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._buffer = bytearray()

    def feed(self, data: memoryview) -> None:
        self._buffer += data

    def take(self) -> bytes | None:
        if len(self._buffer) < LENGTH.size:
            return None
        (length,) = LENGTH.unpack_from(self._buffer)
        if length > self._most:
            raise TooLongError(f"a packet of {length} bytes, and at most {self._most} are taken")
        end = LENGTH.size + length
        if len(self._buffer) < end:
            return None
        packet = bytes(memoryview(self._buffer)[LENGTH.size : end])
        del self._buffer[:end]
        return packet

    def __len__(self) -> int:
        return len(self._buffer)

    def clear(self) -> None:
        self._buffer.clear()


class Lines:
    r"""Each ended by `\n`, or `\r\n`."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._buffer = bytearray()
        self._searched = 0

    def feed(self, data: memoryview) -> None:
        self._buffer += data

    def take(self) -> bytes | None:
        end = self._buffer.find(b"\n", self._searched)
        self._searched = len(self._buffer) if end < 0 else 0
        if max(end, self._searched) > self._most:
            raise TooLongError(f"a line of more than {self._most} bytes")
        if end < 0:
            return None
        line = bytes(memoryview(self._buffer)[:end])
        del self._buffer[: end + 1]
        return line.removesuffix(b"\r")

    def __len__(self) -> int:
        return len(self._buffer)

    def clear(self) -> None:
        self._buffer.clear()
        self._searched = 0

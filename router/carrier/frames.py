"""The frames of byte streams (`native/framing.c`), for tools that are at an end of a stream themselves."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import NamedTuple

from router import declared as c
from router.declared import LONGEST_FRAME
from router.library import library

_SHOWN = 64
"""Bytes of a bad frame that are kept."""


class Frame(NamedTuple):
    """A frame's payload; of a bad one, why it is bad, and its first bytes as they arrived."""

    data: bytes
    problem: str = ""


_PROBLEMS = {c.Framed.BAD: "bad_frame", c.Framed.BAD_CHECKSUM: "bad_checksum"}


class Codec:
    """Reads and writes the frames of one stream."""

    def __init__(self, framing: c.Framing) -> None:
        self._library = library()
        self._framing = framing
        self._deframer = c.Deframer()
        self._buffer = ctypes.create_string_buffer(LONGEST_FRAME)
        self.begin()

    def begin(self) -> None:
        """Begin another stream: forget a partial frame."""
        self._arrived = b""
        self._library.deframer_begin(ctypes.byref(self._deframer), ctypes.byref(self._framing))

    @property
    def delimiter(self) -> bytes:
        """What ends any frame that has begun; empty for a framing that has none."""
        delimiter = self._library.framing_delimiter(ctypes.byref(self._framing))
        return b"" if delimiter < 0 else bytes([delimiter])

    def write(self, payload: bytes) -> bytes:
        """Return a frame; empty if the framing has no length for so many bytes."""
        size = self._library.frame_write(ctypes.byref(self._framing), payload, len(payload), self._buffer)
        return self._buffer.raw[:size]

    def read(self, data: bytes) -> Iterator[Frame]:
        """Yield the frames that are complete with these bytes.

        After a bad frame of a stream without delimiters, the rest of `data` is not read, and the next frame begins with
        the bytes that follow.
        """
        held = ctypes.create_string_buffer(data, len(data))
        begin = ctypes.addressof(held)
        at, end = ctypes.c_void_p(begin), ctypes.c_void_p(begin + len(data))
        start = 0
        while True:
            framed = self._library.deframe(ctypes.byref(self._deframer), ctypes.byref(at), end)
            taken = (at.value or begin) - begin
            arrived = (self._arrived + data[start:taken])[:_SHOWN]
            start, self._arrived = taken, arrived
            if framed == c.Framed.PARTIAL:
                return
            self._arrived = b""
            if framed == c.Framed.READY:
                yield Frame(ctypes.string_at(self._payload(), self._deframer.length))
                continue
            yield Frame(arrived, _PROBLEMS[c.Framed(framed)])
            if not self.delimiter:
                self.begin()
                return

    def _payload(self) -> int:
        field = ctypes.addressof(self._deframer) + c.Deframer.payload.offset
        return ctypes.c_void_p.from_address(field).value or 0

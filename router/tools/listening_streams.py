"""Packets and documents from the bytes of a TCP connection. Knows no sockets.

`gateway_v1`: each packet after its length, u32 little-endian. `json_lines`: a document and a newline.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from router.gateway.packets import PacketError
from router.table.model import GatewayFormat
from router.tools.listening_reading import MOST_TEXT

_LENGTH = struct.Struct("<I")

LONGEST = MOST_TEXT + (1 << 20)
"""Bytes of a packet or document. Any text that begins with `{` would be a longer packet."""


class Splitter:
    """`form` None: the first bytes of the connection tell."""

    def __init__(self, form: GatewayFormat | None) -> None:
        self._form = form
        self._buffer = bytearray()
        self._searched = 0

    @property
    def unfinished(self) -> int:
        """Bytes of what has not come to its end."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Iterator[bytes]:
        """What is whole now. Raises PacketError when there is no telling where the next begins."""
        self._buffer += data
        if self._form is None and len(self._buffer) >= _LENGTH.size:
            is_text = self._buffer.startswith(b"{") and self._length() > LONGEST
            self._form = GatewayFormat.JSON_LINES if is_text else GatewayFormat.GATEWAY_V1
        if self._form is GatewayFormat.JSON_LINES:
            yield from self._lines()
        elif self._form is GatewayFormat.GATEWAY_V1:
            yield from self._packets()

    def _length(self) -> int:
        [length] = _LENGTH.unpack_from(self._buffer)
        return int(length)

    def _packets(self) -> Iterator[bytes]:
        while len(self._buffer) >= _LENGTH.size:
            end = _LENGTH.size + self._length()
            if end > LONGEST:
                raise PacketError(f"a packet of {end - _LENGTH.size} bytes")
            if len(self._buffer) < end:
                return
            yield bytes(self._buffer[_LENGTH.size : end])
            del self._buffer[:end]

    def _lines(self) -> Iterator[bytes]:
        while (end := self._buffer.find(b"\n", self._searched)) >= 0:
            yield bytes(self._buffer[:end])
            del self._buffer[: end + 1]
            self._searched = 0
        self._searched = len(self._buffer)
        if self._searched > LONGEST:
            raise PacketError(f"a line of more than {LONGEST} bytes")

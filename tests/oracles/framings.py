"""Frames of byte streams, plain and slow. COBS and CRCs are those of libraries.

`encoded` makes the frame of a payload. `decoded` reads a whole stream: what comes out of it, in order, and whether it
can be read on at the end.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from cobs import cobs  # type: ignore[import-untyped]
from crccheck.crc import (  # type: ignore[import-untyped]
    Crc8Smbus,
    Crc16Ibm3740,
    Crc16Modbus,
    Crc16Xmodem,
)

Order = Literal["little", "big"]

CHECKSUMS: dict[str, tuple[int, Callable[[bytes], int]]] = {
    "none": (0, lambda _: 0),
    "crc8": (1, Crc8Smbus.calc),
    "crc16_xmodem": (2, Crc16Xmodem.calc),
    "crc16_ccitt_false": (2, Crc16Ibm3740.calc),
    "crc16_modbus": (2, Crc16Modbus.calc),
    "crc32": (4, zlib.crc32),
}
"""The size of each in bytes, and its function."""

LENGTHS: dict[str, tuple[int, Order]] = {
    "u8": (1, "little"),
    "u16le": (2, "little"),
    "u16be": (2, "big"),
    "u32le": (4, "little"),
    "u32be": (4, "big"),
}
DELIMITERS = {"cobs": 0x00, "slip": 0xC0, "hdlc": 0x7E}
ESCAPES = {"slip": {0xC0: b"\xdb\xdc", 0xDB: b"\xdb\xdd"}, "hdlc": {0x7E: b"\x7d\x5e", 0x7D: b"\x7d\x5d"}}
CONTROL = 0x03

BAD, BAD_CHECKSUM = "bad", "bad checksum"


@dataclass(frozen=True)
class Framing:
    kind: str
    checksum: str = "none"
    is_big_endian: bool = False
    address: int = 82

    @property
    def order(self) -> Order:
        return "big" if self.is_big_endian else "little"

    @property
    def header(self) -> bytes:
        return bytes([self.address << 1 | 1, CONTROL]) if self.kind == "hdlc" else b""


class BadFrameError(Exception):
    """A frame is not encoded as its framing demands."""


def encoded(framing: Framing, payload: bytes) -> bytes:
    size, checksum = CHECKSUMS[framing.checksum]
    content = framing.header + payload
    content += checksum(content).to_bytes(size, framing.order)
    if framing.kind == "cobs":
        return bytes(cobs.encode(content)) + b"\0"
    if framing.kind in ESCAPES:
        escapes, flag = ESCAPES[framing.kind], bytes([DELIMITERS[framing.kind]])
        escaped = b"".join(escapes.get(byte, bytes([byte])) for byte in content)
        return (flag if framing.kind == "hdlc" else b"") + escaped + flag
    if framing.kind == "varint":
        return _varint(len(content)) + content
    width, order = LENGTHS[framing.kind]
    return len(content).to_bytes(width, order) + content


def decoded(framing: Framing, stream: bytes, limit: int) -> tuple[list[bytes | str], bool]:
    most = len(framing.header) + limit + CHECKSUMS[framing.checksum][0]
    found: list[bytes | str] = []
    if framing.kind in DELIMITERS:
        *frames, _ = stream.split(bytes([DELIMITERS[framing.kind]]))
        found += [_checked(framing, frame, most) for frame in frames if frame]
        return found, True
    for content in _counted(framing, stream, most):
        found.append(BAD if content is None else _payload(framing, content))
        if found[-1] in (BAD, BAD_CHECKSUM):
            return found, False
    return found, True


def _checked(framing: Framing, frame: bytes, most: int) -> bytes | str:
    try:
        content = cobs.decode(frame) if framing.kind == "cobs" else _unescaped(framing.kind, frame)
    except (BadFrameError, cobs.DecodeError):
        return BAD
    return BAD if len(content) > most else _payload(framing, content)


def _payload(framing: Framing, content: bytes) -> bytes | str:
    size, checksum = CHECKSUMS[framing.checksum]
    if len(content) < size + len(framing.header):
        return BAD
    kept, written = content[: len(content) - size], content[len(content) - size :]
    if checksum(kept).to_bytes(size, framing.order) != written:
        return BAD_CHECKSUM
    return kept[len(framing.header) :] if kept.startswith(framing.header) else BAD


def _unescaped(kind: str, frame: bytes) -> bytes:
    plain, rest = bytearray(), iter(frame)
    escape = ESCAPES[kind][DELIMITERS[kind]][0]
    for byte in rest:
        if byte != escape:
            plain.append(byte)
            continue
        follows = next(rest, None)
        meant = [each for each, escaped in ESCAPES[kind].items() if escaped[1] == follows]
        if follows is not None and kind == "hdlc":
            meant = [follows ^ 0x20]
        if not meant:
            raise BadFrameError
        plain.append(meant[0])
    return bytes(plain)


def _varint(number: int) -> bytes:
    digits = bytearray()
    while number >= 0x80:
        digits.append(number % 0x80 + 0x80)
        number //= 0x80
    return bytes([*digits, number])


def _counted(framing: Framing, stream: bytes, most: int) -> Iterator[bytes | None]:
    """Yield the contents of complete frames; None, at the end, for a length that cannot be."""
    while stream:
        if framing.kind == "varint":
            width = next((at for at, byte in enumerate(stream[:5], 1) if byte < 0x80), None)
            if width is None and len(stream) < 5:
                return
            length = sum((byte & 0x7F) << 7 * at for at, byte in enumerate(stream[: width or 5]))
        else:
            width, order = LENGTHS[framing.kind]
            if len(stream) < width:
                return
            length = int.from_bytes(stream[:width], order)
        if width is None or length > most:
            yield None
            return
        if len(stream) < width + length:
            return
        yield stream[width : width + length]
        stream = stream[width + length :]

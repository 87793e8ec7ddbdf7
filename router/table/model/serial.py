"""Listeners that are serial lines: the settings of the line, and the frames in its byte stream."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from router.errors import Located, SourceSpan
from router.table.keys import Range, Shape

LENGTHS = ("u8", "u16le", "u16be", "u32le", "u32be")
HDLC_ADDRESS = 82
"""The address that Pigweed uses for its RPC by default."""


@dataclass(frozen=True, slots=True)
class StreamFraming:
    """How a byte stream is divided into frames: `cobs`, `slip`, `hdlc`, `varint`, or one of LENGTHS."""

    kind: str
    address: int = HDLC_ADDRESS

    def __str__(self) -> str:
        if self.kind in LENGTHS:
            return f"{{length: {self.kind}}}"
        return self.kind if self.address == HDLC_ADDRESS else f"{{{self.kind}: {self.address}}}"


class ChecksumKind(enum.Enum):
    """The names of the CRC catalogue, or shorter ones that are common."""

    CRC8 = "crc8"
    CRC16_XMODEM = "crc16_xmodem"
    CRC16_CCITT_FALSE = "crc16_ccitt_false"
    CRC16_MODBUS = "crc16_modbus"
    CRC32 = "crc32"

    @property
    def size(self) -> int:
        """Bytes."""
        return _SIZES[self.value]


_SIZES: Mapping[str, int] = {
    "crc8": 1,
    "crc16_xmodem": 2,
    "crc16_ccitt_false": 2,
    "crc16_modbus": 2,
    "crc32": 4,
}


@dataclass(frozen=True, slots=True)
class Checksum:
    """A checksum behind each payload; `is_big_endian`: its high byte comes first."""

    kind: ChecksumKind
    is_big_endian: bool = False

    def __str__(self) -> str:
        return f"{{{self.kind.value}: be}}" if self.is_big_endian else self.kind.value


class Parity(enum.Enum):
    NONE = "none"
    EVEN = "even"
    ODD = "odd"


@dataclass(frozen=True, slots=True)
class SerialLine:
    """A serial line to a board. Each frame on it has one envelope.

    `span` is the listener's name in the table.
    """

    NOUN: ClassVar[str] = "serial line"

    span: SourceSpan
    serial: Annotated[Located[str], Shape("device")]
    """The device. The names in /dev/serial/by-id stay the same when it is unplugged and plugged in again.

    Example: /dev/serial/by-id/usb-board-if00
    Example: /dev/ttyAMA0
    """
    baud: Annotated[int, Range(50, 20_000_000)]
    """Bits per second, any number that the device can do. It also bounds what may wait to be sent: 10 ms of the line.

    Example: 460800
    """
    framing: Annotated[StreamFraming, Shape("stream_framing")]
    checksum: Annotated[Checksum | None, Shape("checksum")] = None
    parity: Parity = Parity.NONE
    """The parity bit of each byte."""
    stop_bits: Annotated[int, Range(1, 2)] = 1
    """The number of stop bits after each byte."""
    envelope: Located[str] | None = None
    """Which of the table's `envelopes` its frames are. Needed if there are several.

    Example: robot
    """

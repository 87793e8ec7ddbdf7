"""Pictures for the tests of the gateway's page, and what it shows of them."""

from __future__ import annotations

import struct
import zlib
from typing import Any

from tests.gateway.browser import Page

IMAGE = "sensor_msgs/msg/CompressedImage"
TIMES = "\N{MULTIPLICATION SIGN}"


def png(width: int, height: int, colour: tuple[int, int, int]) -> bytes:
    """A file of one colour."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes(colour) * width) * height
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def compressed_image(data: bytes | str, told: str) -> dict[str, Any]:
    """The data of its document: a `uint8[]` is a list of numbers."""
    header = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "camera"}
    return {"header": header, "format": told, "data": data if isinstance(data, str) else list(data)}


def shown_pixel(page: Page) -> list[int]:
    """Red, green, blue and alpha of the middle of the picture that the page shows."""
    found: list[int] = page.evaluate(
        "(() => { const canvas = document.querySelector('#picture canvas');"
        "return [...canvas.getContext('2d').getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data]; })()"
    )
    return found

"""Pictures for tests of the gateway's page, and the pixels that it shows."""

from __future__ import annotations

import io
from typing import Any

from PIL import Image

from tests.gateway.browser import Page

IMAGE = "sensor_msgs/msg/CompressedImage"
TIMES = "\N{MULTIPLICATION SIGN}"


def png(width: int, height: int, colour: tuple[int, int, int]) -> bytes:
    """A PNG file with one colour."""
    file = io.BytesIO()
    Image.new("RGB", (width, height), colour).save(file, "PNG")
    return file.getvalue()


def compressed_image(data: bytes | str, told: str) -> dict[str, Any]:
    """The `data` of a CompressedImage's document: a `uint8[]` is a list of numbers."""
    header = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "camera"}
    return {"header": header, "format": told, "data": data if isinstance(data, str) else list(data)}


def shown_pixel(page: Page) -> list[int]:
    """Red, green, blue and alpha in the centre of the picture that the page shows."""
    found: list[int] = page.evaluate(
        "(() => { const canvas = document.querySelector('#picture canvas');"
        "return [...canvas.getContext('2d').getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data]; })()"
    )
    return found

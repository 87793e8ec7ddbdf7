"""`make pictures` takes each picture from the running program while it shows what the picture is of."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
import zlib
from pathlib import Path

import numpy as np
import pytest

from docs.pictures.make import DESKTOP
from docs.pictures.png import COLOURS, png
from tests.gateway.browser import executable

ROOT = Path(__file__).parents[1]
LIMIT = 300_000
"""Bytes of a picture in the README."""


@pytest.mark.slow
@pytest.mark.skipif(executable() is None, reason="no Chromium here")
def test_each_picture_shows_what_it_is_of(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "docs.pictures.make", str(tmp_path), "--settled", "2"]
    taken = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=280)
    assert taken.returncode == 0, taken.stdout + taken.stderr
    said = dict(line.split(": ", 1) for line in taken.stdout.splitlines())
    assert set(said) == {path.name for path in tmp_path.iterdir()}
    assert set(said) == {"status.png", "gateway.png", "cut-off.png", "route-map.svg", "top.svg"}

    sizes = {path.name: struct.unpack(">II", path.read_bytes()[16:24]) for path in tmp_path.glob("*.png")}
    assert sizes["gateway.png"] == sizes["cut-off.png"] == DESKTOP
    assert sizes["status.png"] > DESKTOP
    assert all(10_000 < path.stat().st_size < LIMIT for path in tmp_path.iterdir())

    assert "sensor_board" in said["status.png"]
    assert "silent for" not in said["status.png"]
    assert re.search(r"basestation\b.{0,40}\bsilent", said["cut-off.png"])
    assert "linear_acceleration" in said["gateway.png"]
    assert "sensor_board" in said["top.svg"]


def test_vector_pictures_refer_to_nothing_outside() -> None:
    for file in (ROOT / "docs" / "pictures").glob("*.svg"):
        ET.parse(file)  # noqa: S314 - our own
        text = file.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.findall(r"url\(['\"]?\w+:|@import|href=|<script", text)


def pixels_of(data: bytes) -> tuple[int, int, list[bytes]]:
    """Width, height and RGBA pixels of an indexed PNG whose rows have no filter."""
    chunks, at = {}, 8
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        chunks[kind] = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + chunks[kind])
        at += 12 + length
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    rows = zlib.decompress(chunks[b"IDAT"])
    indices = [index for row in range(height) for index in rows[row * (width + 1) + 1 : (row + 1) * (width + 1)]]
    colours = [chunks[b"PLTE"][3 * i : 3 * i + 3] + chunks[b"tRNS"][i : i + 1] for i in range(len(chunks[b"tRNS"]))]
    return width, height, [colours[index] for index in indices]


def test_a_picture_of_few_colours_stays_as_it_is() -> None:
    colours = [bytes([3 * i, 255 - i, i, 128 + i]) for i in range(80)]
    pixels = [colours[i % 80] for i in range(30 * 20)]
    assert pixels_of(png(b"".join(pixels), 30, 20)) == (30, 20, pixels)


def test_of_many_colours_each_becomes_one_near_to_it() -> None:
    pixels = np.random.default_rng(1).integers(0, 64, (64 * 64, 4), np.uint8)
    width, height, drawn = pixels_of(png(pixels.tobytes(), 64, 64))
    assert (width, height, len(set(drawn)) <= COLOURS) == (64, 64, True)
    far = np.abs(np.frombuffer(b"".join(drawn), np.uint8).reshape(-1, 4).astype(int) - pixels)
    assert far.mean() < 10

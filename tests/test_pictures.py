"""`make pictures` takes each picture from the running program while the program shows its subject."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from PIL import Image

from docs.pictures.make import DESKTOP
from tests.gateway.browser import executable

ROOT = Path(__file__).parents[1]
LIMIT = 300_000
"""Largest picture in the README, in bytes."""


@pytest.mark.slow
@pytest.mark.skipif(executable() is None, reason="no Chromium here")
def test_each_picture_shows_what_it_is_of(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "docs.pictures.make", str(tmp_path), "--settled", "2"]
    taken = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=280)
    assert taken.returncode == 0, taken.stdout + taken.stderr
    said = dict(line.split(": ", 1) for line in taken.stdout.splitlines())
    assert set(said) == {path.name for path in tmp_path.iterdir()}
    assert set(said) == {"status.png", "gateway.png", "cut-off.png", "route-map.svg", "top.svg"}

    images = {path.name: Image.open(path) for path in tmp_path.glob("*.png")}
    sizes = {name: image.size for name, image in images.items()}
    assert sizes["gateway.png"] == sizes["cut-off.png"] == DESKTOP
    assert sizes["status.png"] > DESKTOP
    alphas = {name: image.convert("RGBA").getchannel("A").getextrema() for name, image in images.items()}
    assert alphas == {"status.png": (0, 255), "gateway.png": (255, 255), "cut-off.png": (255, 255)}
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

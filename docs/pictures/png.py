"""PNG files of at most 256 colours, a third as large as those of a browser."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

Array = Any
"""What numpy has without type hints here."""

_COARSE = 3
"""Low bits of a channel in which colours are taken for the same, if there are too many."""

COLOURS = 256


def png(pixels: bytes, width: int, height: int) -> bytes:
    """A picture as an indexed PNG. `pixels`: RGBA, 8 bits each, rows from the top."""
    indices, palette = _indexed(np.frombuffer(pixels, np.uint8).reshape(-1, 4))
    rows: Array = np.zeros((height, width + 1), np.uint8)  # each begins with its filter: none
    rows[:, 1:] = indices.reshape(height, width)
    return b"".join([
        b"\x89PNG\r\n\x1a\n",
        _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        _chunk(b"PLTE", palette[:, :3].tobytes()),
        _chunk(b"tRNS", palette[:, 3].tobytes()),
        _chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)),
        _chunk(b"IEND", b""),
    ])


def _indexed(pixels: Array) -> tuple[Array, Array]:
    """For each pixel the number of its colour, and the colours: the commonest, and for others the nearest of these."""
    colours, which, counts = np.unique(pixels.view(np.uint32).ravel(), return_inverse=True, return_counts=True)
    exact = colours.view(np.uint8).reshape(-1, 4).astype(np.int32)
    kept = _commonest(exact, counts)
    nearest: Array = np.empty(len(exact), np.uint8)
    for start in range(0, len(exact), 4096):
        part = exact[start : start + 4096, None, :] - kept[None, :, :]
        nearest[start : start + 4096] = (part * part).sum(axis=2).argmin(axis=1)
    return nearest[which.ravel()], kept.astype(np.uint8)


def _commonest(colours: Array, counts: Array) -> Array:
    """At most COLOURS of them; of those that are alike the commonest."""
    order = np.argsort(-counts, kind="stable")
    if len(order) <= COLOURS:
        return colours[order]
    _, first, group = np.unique(colours[order] >> _COARSE, axis=0, return_index=True, return_inverse=True)
    totals = np.bincount(group.ravel(), weights=counts[order])
    return colours[order[first[np.argsort(-totals, kind="stable")[:COLOURS]]]]


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

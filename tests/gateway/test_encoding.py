"""How much a client's message is to read, which is seen before it is."""

from __future__ import annotations

from pathlib import Path

import pytest
from backports import zstd

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.gateway.compression import compress
from router.gateway.encoding import ENCODINGS
from router.gateway.packets import Packet, PacketError, pack
from tests.gateway.stage import program

TEXT = b'{"data":["a word"]}'
TCP = "it: {transport: {tcp: 127.0.0.1:8600}, max_message: 2kB}"


def streamed(data: bytes) -> bytes:
    """A frame that does not say how large its content is."""
    compressor = zstd.ZstdCompressor()
    frame: bytes = compressor.compress(data) + compressor.flush()
    return frame


@pytest.mark.parametrize(
    ("payload", "is_compressed", "size"),
    [
        (TEXT, False, len(TEXT)),
        (compress(TEXT * 50, 3), True, 50 * len(TEXT)),
        (compress(TEXT * 1000, 3), True, 1000 * len(TEXT)),
        (streamed(TEXT), True, None),
        (TEXT, True, 0),  # which is no zstd frame
    ],
)
def test_of_a_packet_what_is_in_it_counts(
    tmp_path: Path, payload: bytes, is_compressed: bool, size: int | None
) -> None:
    [plan] = program(tmp_path, TCP).gateways
    letter = ENCODINGS[plan.settings.format](plan.settings).letter(pack(Packet(1.0, is_compressed, "/a", "b", payload)))
    assert (letter.topic, letter.type_name, letter.size) == ("/a", "b", size)


def test_what_is_no_packet_is_not_read(tmp_path: Path) -> None:
    [plan] = program(tmp_path, TCP).gateways
    with pytest.raises(PacketError):
        ENCODINGS[plan.settings.format](plan.settings).letter(b"\xff" * 60_000)


def test_of_a_document_all_counts(tmp_path: Path) -> None:
    [plan] = program(tmp_path, "it: {transport: {websocket: 127.0.0.1:8600}}").gateways
    assert ENCODINGS[plan.settings.format](plan.settings).letter(TEXT).size == len(TEXT)

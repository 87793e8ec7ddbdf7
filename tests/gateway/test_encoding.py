"""What is read from clients at once, and what beside the loop."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.gateway.compression import compress
from router.gateway.encoding import QUICK, encoding
from router.gateway.packets import Packet, pack
from tests.gateway.stage import program

SMALL, LARGE = b"[" + b" " * 1000 + b"]", b"[" + b" " * QUICK + b"]"


@pytest.mark.parametrize(
    ("payload", "is_compressed", "is_quick"),
    [
        (SMALL, False, True),
        (LARGE, False, False),
        (compress(SMALL, 3), True, True),  # a command need not wait for images
        (compress(LARGE, 3), True, False),
        (LARGE, True, True),  # which is no zstd frame
    ],
)
def test_packets_are_quick_by_what_is_in_them(
    tmp_path: Path, payload: bytes, is_compressed: bool, is_quick: bool
) -> None:
    [plan] = program(tmp_path, "it: {transport: {tcp: 127.0.0.1:8600}}").gateways
    assert encoding(plan.settings).is_quick(pack(Packet(1.0, is_compressed, "/a", "b", payload))) is is_quick


def test_what_is_no_packet_is_refused_at_once(tmp_path: Path) -> None:
    [plan] = program(tmp_path, "it: {transport: {tcp: 127.0.0.1:8600}}").gateways
    assert encoding(plan.settings).is_quick(b"\xff" * 60_000)


def test_documents_are_quick_by_their_length(tmp_path: Path) -> None:
    [plan] = program(tmp_path, "it: {transport: {websocket: 127.0.0.1:8600}}").gateways
    reads = encoding(plan.settings)
    assert reads.is_quick(SMALL)
    assert not reads.is_quick(LARGE)

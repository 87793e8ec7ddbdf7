from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.packets import PacketError
from router.table.model import GatewayFormat
from router.tools.listening_streams import LONGEST, Splitter

V1, LINES = GatewayFormat.GATEWAY_V1, GatewayFormat.JSON_LINES


def framed(packet: bytes) -> bytes:
    return struct.pack("<I", len(packet)) + packet


def fed(splitter: Splitter, stream: bytes, size: int) -> list[bytes]:
    pieces = (stream[start : start + size] for start in range(0, len(stream), size))
    return [whole for piece in pieces for whole in splitter.feed(piece)]


@given(st.lists(st.binary(max_size=300)), st.integers(1, 50), st.sampled_from([V1, None]))
def test_packets_are_found_wherever_the_stream_is_cut(
    packets: list[bytes], size: int, form: GatewayFormat | None
) -> None:
    splitter = Splitter(form)
    assert fed(splitter, b"".join(map(framed, packets)), size) == packets
    assert splitter.unfinished == 0


@given(st.lists(st.binary(max_size=50).map(lambda text: b'{"op"' + text.replace(b"\n", b""))), st.integers(1, 50))
def test_lines_are_found_and_recognised_wherever_the_stream_is_cut(lines: list[bytes], size: int) -> None:
    stream = b"".join(line + b"\n" for line in lines)
    assert fed(Splitter(LINES), stream, size) == lines
    assert fed(Splitter(None), stream, size) == lines


def test_a_packet_whose_length_begins_like_a_document_is_a_packet() -> None:
    packet = b"x" * ord("{")
    assert fed(Splitter(None), framed(packet), 200) == [packet]


def test_what_is_unfinished_is_known() -> None:
    splitter = Splitter(V1)
    assert list(splitter.feed(framed(b"abc") + b"\5\0\0\0ab")) == [b"abc"]
    assert splitter.unfinished == 6


def test_a_length_that_no_packet_has_ends_the_stream() -> None:
    with pytest.raises(PacketError, match=f"a packet of {LONGEST} bytes"):
        list(Splitter(V1).feed(struct.pack("<I", LONGEST)))

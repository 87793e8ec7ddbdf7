"""Frames as tools read and write them."""

from __future__ import annotations

import pytest

from router import declared as c
from router.carrier.frames import Codec, Frame
from tests.oracles import framings as oracle

COBS = oracle.Framing("cobs", "crc16_modbus")
PAYLOADS = [b"1", b"\0" * 300, b"", b"frame"]


@pytest.fixture
def codec() -> Codec:
    return Codec(c.Framing(c.FramingKind.COBS, c.ChecksumKind.CRC16_MODBUS))


def test_frames_are_read_across_pieces(codec: Codec) -> None:
    stream = b"".join(map(codec.write, PAYLOADS))
    assert stream == b"".join(oracle.encoded(COBS, payload) for payload in PAYLOADS)
    pieces = [stream[at : at + 7] for at in range(0, len(stream), 7)]
    assert [frame for piece in pieces for frame in codec.read(piece)] == [Frame(payload) for payload in PAYLOADS]


def test_of_a_bad_frame_the_first_bytes_are_shown(codec: Codec) -> None:
    frame = bytearray(codec.write(b"frame"))
    frame[1] ^= 1
    assert [*codec.read(bytes(frame[:3]))] == []
    assert [*codec.read(bytes(frame[3:]) + b"\x05\x01\0" + codec.write(b"next"))] == [
        Frame(bytes(frame), "bad_checksum"),
        Frame(b"\x05\x01\0", "bad_frame"),
        Frame(b"next"),
    ]
    assert [*codec.read(b"\x01" * 40_000 + b"\0")] == [Frame(b"\x01" * 64, "bad_frame")]


def test_a_partial_frame_is_forgotten_when_another_stream_begins(codec: Codec) -> None:
    assert [*codec.read(codec.write(b"frame")[:4])] == []
    codec.begin()
    assert [*codec.read(codec.write(b"next"))] == [Frame(b"next")]


def test_without_delimiters_the_next_frame_begins_with_what_arrives_next() -> None:
    codec = Codec(c.Framing(c.FramingKind.LENGTH_U16LE))
    assert [*codec.read(codec.write(b"frame") + b"\xff\xff" + codec.write(b"lost"))] == [
        Frame(b"frame"),
        Frame(b"\xff\xff", "bad_frame"),
    ]
    assert [*codec.read(codec.write(b"next"))] == [Frame(b"next")]


def test_a_payload_without_a_length_is_not_written() -> None:
    assert Codec(c.Framing(c.FramingKind.LENGTH_U8)).write(bytes(256)) == b""

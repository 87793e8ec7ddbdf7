"""Frames of byte streams: the carrier and the oracle agree on every stream, however it is damaged and cut."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router import declared as c
from router.declared import LONGEST_FRAME, MAX_DATAGRAM
from tests.oracles import framings as oracle
from tests.oracles.framings import BAD, BAD_CHECKSUM, CHECKSUMS, DELIMITERS, LENGTHS, Framing

KINDS = [*DELIMITERS, "varint", *LENGTHS]
CHECK = b"123456789"

FRAMINGS = [
    Framing(kind, checksum, is_big_endian)
    for kind in KINDS
    for checksum in (["crc32"] if kind == "hdlc" else CHECKSUMS)
    for is_big_endian in ([False] if kind == "hdlc" else [False, True])
]
framings = st.sampled_from(FRAMINGS)
special = st.sampled_from(b"\x00\x01\x03\x5d\x5e\x7d\x7e\x7f\x80\xa5\xc0\xdb\xdc\xdd\xff")
payloads = st.lists(special | st.integers(0, 255), max_size=40).map(bytes) | st.integers(250, 520).map(CHECK.ljust)


def structure(framing: Framing) -> c.Framing:
    kind = f"LENGTH_{framing.kind}" if framing.kind in LENGTHS else framing.kind
    return c.Framing(
        kind=c.FramingKind[kind.upper()],
        checksum=c.ChecksumKind[framing.checksum.upper()],
        is_big_endian=framing.is_big_endian,
        address=framing.address,
    )


class Deframer:
    """A deframer of the carrier. `found` is what has come out of it; it stops where the stream must be opened again."""

    def __init__(self, library: ctypes.CDLL, framing: Framing) -> None:
        self.found: list[bytes | str] = []
        self.goes_on = True
        self._library, self._framing, self._structure = library, structure(framing), c.Deframer()
        library.deframer_begin(ctypes.byref(self._structure), ctypes.byref(self._framing))

    def take(self, data: bytes) -> None:
        buffer = ctypes.create_string_buffer(data, len(data))
        at, end = ctypes.c_void_p(ctypes.addressof(buffer)), ctypes.c_void_p(ctypes.addressof(buffer) + len(data))
        while self.goes_on:
            framed = self._library.deframe(ctypes.byref(self._structure), ctypes.byref(at), end)
            if framed == c.Framed.PARTIAL:
                assert at.value == end.value
                return
            if framed == c.Framed.READY:
                field = ctypes.addressof(self._structure) + c.Deframer.payload.offset
                payload = ctypes.c_void_p.from_address(field).value
                assert payload is not None
                self.found.append(ctypes.string_at(payload, self._structure.length))
            else:
                self.found.append(BAD if framed == c.Framed.BAD else BAD_CHECKSUM)
                self.goes_on = self._library.framing_delimiter(ctypes.byref(self._framing)) >= 0


def written(library: ctypes.CDLL, framing: Framing, payload: bytes) -> bytes:
    to = ctypes.create_string_buffer(LONGEST_FRAME)
    size = library.frame_write(ctypes.byref(structure(framing)), payload, len(payload), to)
    return to.raw[:size]


def read(library: ctypes.CDLL, framing: Framing, pieces: Iterable[bytes]) -> tuple[list[bytes | str], bool]:
    deframer = Deframer(library, framing)
    for piece in pieces:
        deframer.take(piece)
    return deframer.found, deframer.goes_on


@pytest.mark.parametrize("checksum", [each for each in CHECKSUMS if each != "none"])
def test_checksums_are_those_of_the_catalogue(library: ctypes.CDLL, checksum: str) -> None:
    size, function = CHECKSUMS[checksum]
    kind = c.ChecksumKind[checksum.upper()]
    assert library.checksum_size(kind) == size
    for data in (b"", CHECK, bytes(range(256)), b"\0" * 100):
        assert library.checksum_of(kind, data, len(data)) & 0xFFFFFFFF == function(data)


@given(framing=framings, payload=payloads)
def test_a_frame_is_written_as_the_oracle_writes_it(library: ctypes.CDLL, framing: Framing, payload: bytes) -> None:
    content = len(payload) + CHECKSUMS[framing.checksum][0]
    if framing.kind == "u8" and content > 255:
        assert written(library, framing, payload) == b""
    else:
        assert written(library, framing, payload) == oracle.encoded(framing, payload)


@given(
    framing=framings,
    sent=st.lists(payloads.filter(lambda payload: len(payload) < 200), max_size=6),
    cuts=st.lists(st.integers(0, 1500), max_size=8),
)
def test_payloads_come_out_as_they_went_in_wherever_the_stream_is_cut(
    library: ctypes.CDLL, framing: Framing, sent: list[bytes], cuts: list[int]
) -> None:
    stream = b"".join(written(library, framing, payload) for payload in sent)
    if framing.kind == "slip" and framing.checksum == "none":
        sent = [payload for payload in sent if payload]  # an empty frame looks like an idle line
    pieces = [stream[start:end] for start, end in pairwise([0, *sorted(cuts), len(stream)])]
    assert read(library, framing, pieces) == (sent, True)


@given(framing=framings, sent=st.lists(payloads, min_size=1, max_size=4), data=st.data())
def test_a_damaged_stream_is_read_as_the_oracle_reads_it(
    library: ctypes.CDLL, framing: Framing, sent: list[bytes], data: st.DataObject
) -> None:
    """Bytes are flipped, lost, doubled and inserted."""
    stream = bytearray(b"".join(written(library, framing, payload) for payload in sent))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(stream)))
        change = data.draw(st.sampled_from(["flip", "lose", "double", "insert"]))
        if change == "flip":
            stream[at : at + 1] = bytes(byte ^ data.draw(st.integers(1, 255)) for byte in stream[at : at + 1])
        elif change == "lose":
            del stream[at : at + data.draw(st.integers(1, 5))]
        elif change == "double":
            stream[at:at] = stream[at : at + data.draw(st.integers(1, 5))]
        else:
            stream[at:at] = data.draw(st.lists(special, max_size=3).map(bytes))
    assert read(library, framing, [bytes(stream)]) == oracle.decoded(framing, bytes(stream), MAX_DATAGRAM)


@given(framing=framings, noise=st.lists(special | st.integers(0, 255), max_size=300).map(bytes))
def test_noise_is_read_as_the_oracle_reads_it(library: ctypes.CDLL, framing: Framing, noise: bytes) -> None:
    pieces = [noise[at : at + 1] for at in range(len(noise))]
    assert read(library, framing, pieces) == oracle.decoded(framing, noise, MAX_DATAGRAM)


@pytest.mark.parametrize("framing", [each for each in FRAMINGS if each.kind in DELIMITERS], ids=str)
def test_the_next_frame_is_read_wherever_one_breaks_off(library: ctypes.CDLL, framing: Framing) -> None:
    """As when a board is reset in the middle of a frame: at most the frame after it is lost.

    A checksum that begins with zero does not detect two frames that a lost delimiter joins.
    """
    payload = b"\x00\x7e\x7d\xc0\xdb" + CHECK
    frame = written(library, framing, payload)
    for cut in range(len(frame)):
        found, _ = read(library, framing, [frame[:cut], frame, frame])
        assert found[-1] == payload
        if framing.checksum in ("crc16_ccitt_false", "crc16_modbus", "crc32"):
            assert {*found} <= {payload, BAD, BAD_CHECKSUM}


@pytest.mark.parametrize("framing", [each for each in FRAMINGS if each.kind != "u8"], ids=str)
def test_the_longest_payload_fits_and_a_longer_one_is_a_bad_frame(library: ctypes.CDLL, framing: Framing) -> None:
    longest = bytes(range(1, 256)) * (MAX_DATAGRAM // 255) + b"\xc0" * (MAX_DATAGRAM % 255)
    assert read(library, framing, [written(library, framing, longest)]) == ([longest], True)
    assert written(library, framing, longest + b"!") == b""
    after = oracle.encoded(framing, longest + b"!") + oracle.encoded(framing, CHECK)
    found, goes_on = read(library, framing, [after])
    assert (found, goes_on) == (([BAD, CHECK], True) if framing.kind in DELIMITERS else ([BAD], False))

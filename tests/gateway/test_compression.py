from __future__ import annotations

import tracemalloc
from contextlib import suppress

import pytest
import zstandard
from backports import zstd
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.compression import compress, decompress, told_size
from router.gateway.packets import PacketError

MOST = 1 << 20


@given(st.binary(max_size=300), st.sampled_from([1, 3, 19, 22]))
def test_what_is_compressed_reads_as_it_was(data: bytes, level: int) -> None:
    assert decompress(compress(data, level), len(data)) == data


@pytest.mark.parametrize("size", [0, 1, 65_536, 65_537, MOST])
@pytest.mark.parametrize("level", [1, 3, 19])
def test_the_existing_clients_read_it_in_one_call(size: int, level: int) -> None:
    data = (b'{"x":[0.01]}' * (size // 12 + 1))[:size]
    frame = compress(data, level)
    assert zstd.get_frame_info(frame).decompressed_size == size
    assert zstandard.ZstdDecompressor().decompress(frame) == data


def streamed(data: bytes, **options: int) -> bytes:
    """A frame that does not say how large its content is."""
    chosen = {zstd.CompressionParameter[name].value: value for name, value in options.items()}
    compressor = zstd.ZstdCompressor(options=chosen)
    frame: bytes = compressor.compress(data) + compressor.flush()
    return frame


def test_frames_of_other_senders_are_read() -> None:
    assert decompress(streamed(b"a" * MOST, compression_level=19), MOST) == b"a" * MOST
    assert decompress(streamed(b"abc", checksum_flag=1), 3) == b"abc"


@pytest.mark.parametrize("frame", [streamed(b"\0" * (64 << 20)), compress(b"\0" * (64 << 20), 3)])
def test_a_bomb_is_refused_and_takes_no_memory(frame: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(PacketError, match="bytes uncompressed"):
        decompress(frame, MOST)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * MOST + 100_000


def test_a_frame_that_tells_less_than_it_holds_is_refused_where_that_is_seen() -> None:
    frame = bytearray(compress(b"\0" * (8 << 20), 3))
    assert told_size(bytes(frame)) == 8 << 20
    at = frame.index((8 << 20).to_bytes(4, "little"))
    frame[at : at + 4] = (1000).to_bytes(4, "little")
    assert told_size(bytes(frame)) == 1000
    tracemalloc.start()
    with pytest.raises(PacketError):
        decompress(bytes(frame), 16 << 20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize(
    ("frame", "told"),
    [(compress(b"abc", 3), 3), (streamed(b"abc"), None), (b"", 0), (b"{}", 0), (bytes.fromhex("28b52ffd"), 0)],
)
def test_what_a_frame_tells(frame: bytes, told: int | None) -> None:
    assert told_size(frame) == told


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (b"", "no zstd frame"),
        (b"{}", "no zstd frame"),
        (bytes.fromhex("502a4d180100000061"), "no zstd frame"),  # one to be skipped
        (bytes.fromhex("28b52ffd"), "ends before its zstd frame does"),
        (compress(b"abc" * 100, 3)[:-1], "ends before its zstd frame does"),
        (streamed(b"abc", checksum_flag=1)[:-1], "ends before its zstd frame does"),
        (streamed(b"abc", checksum_flag=1)[:-1] + b"\0", "cannot be decompressed"),
        (compress(b"a", 3) + compress(b"b", 3), "bytes follow"),
        (compress(b"a", 3) + b"\0", "bytes follow"),
        (streamed(b"a" * MOST, window_log=27), "cannot be decompressed: .*memory"),
        (compress(b"aa", 3), "2 bytes uncompressed, more than 1"),
        (streamed(b"aa"), "more than 1 bytes uncompressed"),
    ],
)
def test_anything_else_than_one_sound_frame_is_refused(frame: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        decompress(frame, 1 if "more than 1" in complaint else MOST)


def test_a_frame_that_needs_a_dictionary_is_refused() -> None:
    dictionary = zstd.train_dict([b"abcdefg%d" % number * 10 for number in range(1000)], 2000)
    with pytest.raises(PacketError, match="cannot be decompressed"):
        decompress(zstd.compress(b"abcdefg1" * 20, zstd_dict=dictionary), MOST)


@given(st.binary(max_size=60), st.integers(0, 59), st.integers(0, 255))
def test_any_damage_is_read_or_refused(data: bytes, place: int, byte: int) -> None:
    frame = bytearray(compress(data * 3, 3))
    frame[place % len(frame)] = byte
    with suppress(PacketError):
        assert len(decompress(bytes(frame), 200)) <= 200

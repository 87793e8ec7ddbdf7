from __future__ import annotations

import struct
import tracemalloc
from contextlib import suppress

import pytest
import zstandard
from backports import zstd
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.packets import (
    HEAD,
    LONGEST_NAME,
    Packet,
    PacketError,
    compress,
    datagrams,
    decompress,
    pack,
    unbatched,
    unpack,
)

EXAMPLE = bytes.fromhex(
    "00002040fc54d941002f696d752f646174610073656e736f725f6d7367732f6d73672f496d75007b2278223a5b302e30315d7d"
)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=60)
PACKETS = st.builds(
    Packet,
    time=st.floats(allow_nan=False, allow_infinity=False),
    is_compressed=st.booleans(),
    topic=NAMES,
    type_name=NAMES,
    payload=st.binary(max_size=100),
)


def test_the_example_of_the_existing_gateway_reads_as_what_it_is() -> None:
    packet = unpack(EXAMPLE)
    assert packet == Packet(1700000000.5, False, "/imu/data", "sensor_msgs/msg/Imu", b'{"x":[0.01]}')
    assert pack(packet) == EXAMPLE


@given(PACKETS)
def test_what_is_packed_reads_as_it_was(packet: Packet) -> None:
    assert unpack(pack(packet)) == packet


@given(st.binary(max_size=100) | st.builds(lambda head, rest: head + b"\0" + rest, st.binary(max_size=8), st.binary()))
def test_any_bytes_are_a_packet_or_refused(data: bytes) -> None:
    try:
        packet = unpack(data)
    except PacketError:
        return
    assert pack(packet) == data


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "0 bytes are too short for a packet"),
        (EXAMPLE[:8], "8 bytes are too short for a packet"),
        (EXAMPLE[:12], "the topic does not end within 255 bytes"),
        (EXAMPLE[:30], "the type does not end within 255 bytes"),
        (EXAMPLE[:8] + b"\2" + EXAMPLE[9:], "the packet has the unknown kind 2"),
        (struct.pack("<dB", float("nan"), 0) + EXAMPLE[9:], "the time is not finite: nan"),
        (struct.pack("<dB", float("-inf"), 0) + EXAMPLE[9:], "the time is not finite: -inf"),
        (EXAMPLE[:9] + b"/\xff\0t\0", "the topic is not UTF-8"),
        (EXAMPLE[:9] + b"/t\0\xed\xa0\x80\0", "the type is not UTF-8"),
    ],
)
def test_what_is_no_packet_is_refused_with_the_reason(data: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        unpack(data)


def test_names_are_as_long_as_ros_allows_and_no_longer() -> None:
    longest = Packet(0.0, False, "t" * LONGEST_NAME, "n" * LONGEST_NAME, b"")
    assert unpack(pack(longest)) == longest
    with pytest.raises(PacketError, match="the topic does not end"):
        unpack(pack(longest._replace(topic="t" * (LONGEST_NAME + 1))))
    with pytest.raises(PacketError, match="the type does not end"):
        unpack(pack(longest._replace(type_name="n" * (LONGEST_NAME + 1))))


# batches

STAMP = struct.pack("<d", 5.0)


def packet(size: int, filler: bytes = b"x") -> bytes:
    return STAMP + b"\0" + filler * (size - HEAD.size)


def split(packets: list[bytes], most: int = 100) -> list[bytes]:
    return list(datagrams(packets, most, 5.0))


@given(
    st.lists(st.integers(0, 700).map(lambda size: pack(Packet(1.0, False, "/t", "p/msg/T", b"x" * size)))),
    st.integers(60, 400),
)
def test_packets_arrive_whole_and_in_their_order(packets: list[bytes], most: int) -> None:
    sent = split(packets, most)
    assert all(len(datagram) <= most or datagram in packets for datagram in sent)
    assert [whole for datagram in sent for whole in unbatched(datagram)] == packets


def test_packets_share_a_datagram_until_it_is_full() -> None:
    small = [packet(40, b"%d" % number) for number in range(5)]
    sent = split(small, most=9 + 2 * 42)
    assert [len(datagram) for datagram in sent] == [93, 93, 40]
    assert sent[0] == STAMP + b"\2" + b"".join(struct.pack("<H", 40) + one for one in small[:2])
    assert sent[2] == small[4]


def test_a_packet_that_cannot_share_goes_bare_in_its_turn() -> None:
    assert split([packet(100)]) == [packet(100)]
    assert split([packet(20), packet(95), packet(20)]) == [packet(20), packet(95), packet(20)]
    first, *others = split([packet(20), packet(30), packet(190), packet(25)])
    assert unbatched(first) == [packet(20), packet(30)]
    assert others == [packet(190), packet(25)]


@pytest.mark.parametrize(
    ("datagram", "complaint"),
    [
        (b"12345678", "8 bytes are too short for a packet"),
        (STAMP + b"\2\1", "ends within a length"),
        (STAMP + b"\2\x0a\0" + packet(9), "ends within a packet of 10 bytes"),
        (STAMP + b"\2\x09\0" + STAMP + b"\2", "is a batch itself"),
        (STAMP + b"\2\0\0", "too short for a packet"),
    ],
)
def test_what_is_no_datagram_of_packets_is_refused(datagram: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        unbatched(datagram)


@given(st.binary(max_size=40) | st.binary(max_size=40).map(lambda rest: STAMP + b"\2" + rest))
def test_any_bytes_give_packets_or_are_refused(datagram: bytes) -> None:
    with suppress(PacketError):
        for one in unbatched(datagram):
            with suppress(PacketError):
                unpack(one)


# compression

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
    at = frame.index((8 << 20).to_bytes(4, "little"))
    frame[at : at + 4] = (1000).to_bytes(4, "little")
    tracemalloc.start()
    with pytest.raises(PacketError):
        decompress(bytes(frame), 16 << 20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (b"", "not a zstd frame"),
        (b"{}", "not a zstd frame"),
        (bytes.fromhex("502a4d180100000061"), "not a zstd frame"),  # one to be skipped
        (bytes.fromhex("28b52ffd"), "truncated zstd frame"),
        (compress(b"abc" * 100, 3)[:-1], "truncated zstd frame"),
        (streamed(b"abc", checksum_flag=1)[:-1], "truncated zstd frame"),
        (streamed(b"abc", checksum_flag=1)[:-1] + b"\0", "cannot be decompressed"),
        (compress(b"a", 3) + compress(b"b", 3), "bytes follow"),
        (compress(b"a", 3) + b"\0", "bytes follow"),
        (streamed(b"a" * MOST, window_log=27), "cannot be decompressed: .*memory"),
        (compress(b"aa", 3), "2 bytes uncompressed, more than 1"),
        (streamed(b"aa"), "exceeds 1 bytes uncompressed"),
    ],
)
def test_anything_else_than_one_sound_frame_is_refused(frame: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        decompress(frame, 1 if "1 bytes" in complaint or "more than 1" in complaint else MOST)


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

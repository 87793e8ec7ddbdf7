from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.packets import LONGEST_NAME, Packet, PacketError, pack, prefix, unpack

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


@given(PACKETS)
def test_a_sender_may_put_a_prefix_between_head_and_payload(packet: Packet) -> None:
    head = struct.pack("<dB", packet.time, packet.is_compressed)
    assert head + prefix(packet.topic, packet.type_name) + packet.payload == pack(packet)


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
        (b"", "0 bytes are no packet"),
        (EXAMPLE[:8], "8 bytes are no packet"),
        (EXAMPLE[:12], "the topic does not end within 255 bytes"),
        (EXAMPLE[:30], "the type does not end within 255 bytes"),
        (EXAMPLE[:8] + b"\2" + EXAMPLE[9:], "a packet of kind 2, where 0 and 1 are known"),
        (struct.pack("<dB", float("nan"), 0) + EXAMPLE[9:], "the time is nan"),
        (struct.pack("<dB", float("-inf"), 0) + EXAMPLE[9:], "the time is -inf"),
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

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Iterable
from contextlib import suppress
from itertools import count
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.gateway.fragments import Reassembler, capacity, datagrams
from router.gateway.packets import Packet, PacketError, pack, unpack

SECOND = 1_000_000_000
HEAD = struct.pack("<d", 5.0)

PACKETS = st.lists(st.integers(0, 700).map(lambda size: pack(Packet(1.0, False, "/t", "p/msg/T", b"x" * size))))
MOST = st.integers(60, 400)


def packet(size: int, filler: bytes = b"x") -> bytes:
    return HEAD + b"\0" + filler * (size - 9)


def split(packets: Iterable[bytes], most: int = 100, first: int = 0, time: float = 5.0) -> list[bytes]:
    return list(datagrams(packets, most, time, count(first)))


def fragment(number: int, index: int, parts: int, part: bytes) -> bytes:
    return HEAD + b"\3" + struct.pack("<IHH", number, index, parts) + part


def fed(reassembler: Reassembler, sent: Iterable[bytes], sender: str = "a", now: int = 0) -> list[bytes]:
    return [whole for datagram in sent for whole in reassembler.feed(datagram, sender, now)]


@given(PACKETS, MOST)
def test_packets_arrive_whole_and_in_their_order(packets: list[bytes], most: int) -> None:
    sent = split(packets, most)
    assert all(len(datagram) <= most for datagram in sent)
    assert fed(Reassembler(), sent) == packets


@given(PACKETS, MOST, st.randoms())
def test_order_and_repetition_of_datagrams_do_not_matter(packets: list[bytes], most: int, random: Random) -> None:
    sent = [datagram for datagram in split(packets, most) if datagram[8] == 3] * 2
    random.shuffle(sent)
    large = [whole for whole in packets if len(whole) > most]
    assert sorted(fed(Reassembler(most_open=len(large) + 1), sent)) == sorted(large)


def test_packets_share_a_datagram_until_it_is_full() -> None:
    small = [packet(40, b"%d" % number) for number in range(5)]
    sent = split(small, most=9 + 2 * 42)
    assert [len(datagram) for datagram in sent] == [93, 93, 40]
    assert sent[0] == HEAD + b"\2" + b"".join(struct.pack("<H", 40) + one for one in small[:2])
    assert sent[2] == small[4]


def test_a_packet_that_fits_goes_bare_when_it_cannot_share() -> None:
    assert split([packet(100)]) == [packet(100)]
    assert split([packet(20), packet(95), packet(20)]) == [packet(20), packet(95), packet(20)]


def test_a_large_packet_goes_behind_what_was_before_it() -> None:
    sent = split([packet(20), packet(30), packet(190), packet(25)], first=7)
    assert [datagram[8] for datagram in sent] == [2, 3, 3, 3, 0]
    assert [struct.unpack_from("<IHH", datagram, 9) for datagram in sent[1:4]] == [(7, 0, 3), (7, 1, 3), (7, 2, 3)]
    assert b"".join(datagram[17:] for datagram in sent[1:4]) == packet(190)


def test_a_packet_beyond_the_number_of_fragments_is_refused_after_those_before_it() -> None:
    assert capacity(18) == 65_535
    whole = packet(capacity(18))
    assert fed(Reassembler(), split([whole], most=18)) == [whole]
    sending = datagrams([packet(10), whole + b"x"], 18, 5.0, count())
    assert next(sending) == packet(10)
    with pytest.raises(PacketError, match="does not fit into 65535 datagrams of 18"):
        next(sending)


def test_a_fragment_that_comes_again_after_its_packet_opens_nothing() -> None:
    reassembler = Reassembler()
    sent = split([packet(190)])
    assert fed(reassembler, sent + sent[:1]) == [packet(190)]
    reassembler.look(10 * SECOND)
    assert reassembler.lost == 0


def test_senders_with_the_same_id_do_not_mix() -> None:
    reassembler = Reassembler()
    ones, others = split([packet(190, b"1")]), split([packet(190, b"2")])
    assert fed(reassembler, ones[:2], "a") == []
    assert fed(reassembler, others, "b") == [packet(190, b"2")]
    assert fed(reassembler, ones[2:], "a") == [packet(190, b"1")]


def test_a_sender_that_starts_anew_may_use_its_ids_again() -> None:
    reassembler = Reassembler()
    assert fed(reassembler, split([packet(190, b"1")], time=5.0)) == [packet(190, b"1")]
    assert fed(reassembler, split([packet(290, b"2")], time=6.0)) == [packet(290, b"2")]


def test_a_packet_whose_next_part_does_not_come_in_time_is_lost() -> None:
    reassembler = Reassembler(timeout_ns=SECOND)
    sent = split([packet(190)])
    assert fed(reassembler, sent[:1], now=0) == []
    assert fed(reassembler, sent[1:2], now=SECOND) == []
    reassembler.look(2 * SECOND)
    assert reassembler.lost == 0
    reassembler.look(2 * SECOND + 1)
    assert reassembler.lost == 1
    assert fed(reassembler, sent[2:], now=2 * SECOND + 1) == []  # the rest of it is no packet
    assert fed(reassembler, [packet(20)], now=9 * SECOND) == [packet(20)]
    assert reassembler.lost == 1


def test_of_too_many_open_packets_the_one_that_waits_longest_is_lost() -> None:
    reassembler = Reassembler(most_open=2)
    first, second, third = (split([packet(190, b"%d" % number)], first=number) for number in range(3))
    assert fed(reassembler, [first[0], second[0], first[1], third[0]]) == []
    assert reassembler.lost == 1
    assert fed(reassembler, [*second, *first, *third]) == [packet(190, b"0"), packet(190, b"2")]


def test_memory_is_bounded_whatever_is_sent() -> None:
    reassembler = Reassembler(most_bytes=1 << 20)
    tracemalloc.start()
    for number in range(40):
        fed(reassembler, [fragment(number, index, 65_535, b"x") for index in range(500)])
        fed(reassembler, [fragment(1000 + number, index, 65_535, b"x" * 60_000) for index in range(20)])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 << 20
    assert reassembler.lost >= 60


def test_a_packet_larger_than_all_that_is_kept_is_lost_once() -> None:
    reassembler = Reassembler(most_bytes=1000)
    assert fed(reassembler, split([packet(2000)])) == []
    assert reassembler.lost == 1


@pytest.mark.parametrize(
    ("datagram", "complaint"),
    [
        (b"12345678", "8 bytes are no packet"),
        (fragment(1, 0, 2, b""), "17 bytes are no fragment"),
        (fragment(1, 2, 2, b"x"), "fragment 2 of 2"),
        (fragment(1, 0, 0, b"x"), "fragment 0 of 0"),
        (fragment(1, 0, 1, HEAD + b"\3rest"), "within another"),
        (fragment(1, 0, 1, b"short"), "no packet"),
        (HEAD + b"\2\1", "ends within a length"),
        (HEAD + b"\2\x0a\0" + packet(9), "ends within a packet of 10 bytes"),
        (HEAD + b"\2\x09\0" + HEAD + b"\2", "within another"),
        (HEAD + b"\2\0\0", "no packet"),
    ],
)
def test_what_is_no_datagram_of_packets_is_refused(datagram: bytes, complaint: str) -> None:
    with pytest.raises(PacketError, match=complaint):
        Reassembler().feed(datagram, "a", 0)


def test_fragments_that_contradict_each_other_are_refused() -> None:
    reassembler = Reassembler()
    sent = split([packet(190)])
    fed(reassembler, sent[:1])
    with pytest.raises(PacketError, match="there are 3 and 4"):
        reassembler.feed(fragment(0, 1, 4, b"x"), "a", 0)
    with pytest.raises(PacketError, match="fragment 0 came twice"):
        reassembler.feed(fragment(0, 0, 3, b"x"), "a", 0)
    assert fed(reassembler, sent[1:]) == [packet(190)]


@given(st.lists(st.binary(max_size=40) | st.builds(fragment, *[st.integers(0, 3)] * 3, st.binary(max_size=20))))
def test_any_bytes_give_packets_or_are_refused(sent: list[bytes]) -> None:
    reassembler = Reassembler()
    for datagram in sent:
        try:
            whole = reassembler.feed(datagram, "a", 0)
        except PacketError:
            continue
        for one in whole:
            with suppress(PacketError):
                unpack(one)

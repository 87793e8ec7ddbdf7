"""Trailing zeros: what a sender left out comes back, what it added goes, and what was cut stays refused."""

from __future__ import annotations

import itertools

import pytest
from google.protobuf.message import DecodeError
from hypothesis import example, given
from hypothesis import strategies as st

from router.types.framing import restored
from tests.engine.wire import LEN, damaged, envelopes, framed, rover_envelope, tag, unknown_fields, varint

LIMIT = 16 * 1024


def accepts(data: bytes) -> bool:
    try:
        rover_envelope().message_class.FromString(data)
    except DecodeError:
        return False
    return True


@given(envelopes(), st.integers(0, 64))
@example(framed(13, b""), 1)
@example(tag(30, 0) + varint(0), 3)
@example(framed(13, b"\x0d\0\0\0\0") + tag(30, 0) + varint(128), 0)
@example(b"", 5)
def test_an_envelope_comes_back_whatever_happened_to_its_zeros(envelope: bytes, count: int) -> None:
    trimmed = envelope.rstrip(b"\0")

    assert restored(envelope, LIMIT) == envelope
    assert restored(trimmed, LIMIT) == envelope
    assert restored(envelope + bytes(count), LIMIT) == envelope
    for kept in range(len(trimmed), len(envelope)):
        assert restored(envelope[:kept], LIMIT) == envelope


@given(damaged())
def test_what_the_library_accepts_is_left_alone(data: bytes) -> None:
    if accepts(data):
        assert restored(data, LIMIT) == data


def test_every_payload_case_may_arrive_as_its_tag_alone() -> None:
    for case in rover_envelope().cases.values():
        assert restored(tag(case.number, LEN), LIMIT) == framed(case.number, b"")


@pytest.mark.parametrize(
    ("trimmed", "whole"),
    [
        ("f001", "f00100"),  # varint
        ("f10101", "f1010100000000000000"),  # fixed64
        ("f501", "f50100000000"),  # fixed32
        ("f201", "f20100"),  # length-delimited, empty
        ("f2010501", "f201050100000000"),
        ("6a80", "6a8000"),  # a length that is longer than it needs to be
        ("6a8080", "6a808000"),
        ("6a83", "6a8300000000"),
        ("6a050d00000000f001", "6a050d00000000f00100"),  # behind the payload
    ],
)
def test_the_last_field_may_be_of_any_wire_type(trimmed: str, whole: str) -> None:
    assert restored(bytes.fromhex(trimmed), LIMIT).hex() == whole


@pytest.mark.parametrize(
    "data",
    [
        "ea",  # inside a tag: this could become 13, 29, ...
        "f00180",  # inside a value
        "6a05000000000000ea01",  # padding, then something
        "6b",  # a group
        "6c",  # the end of one
        "6e",  # no wire type
        "6affffffffffffffffffffff01",  # a length of more than ten bytes
    ],
)
def test_what_lacks_more_than_zeros_stays_as_it_is(data: str) -> None:
    assert restored(bytes.fromhex(data), LIMIT).hex() == data


@given(st.integers(LIMIT - 2, 2**64 - 1))
@example(LIMIT - 2)
def test_a_length_above_the_limit_allocates_nothing(length: int) -> None:
    data = tag(13, LEN) + varint(length)
    assert restored(data, LIMIT) is data


def test_the_longest_envelope_within_the_limit_comes_back() -> None:
    envelope = framed(13, bytes(LIMIT - 3))
    assert restored(envelope.rstrip(b"\0"), LIMIT) == envelope


@given(st.binary(max_size=64) | st.lists(unknown_fields).map(b"".join))
def test_any_bytes_keep_all_but_trailing_zeros(data: bytes) -> None:
    whole = restored(data, LIMIT)
    assert whole.rstrip(b"\0") == data.rstrip(b"\0")
    assert len(whole) <= LIMIT


@given(envelopes(), st.data())
def test_a_cut_is_accepted_only_where_it_looks_like_removed_zeros(envelope: bytes, data: st.DataObject) -> None:
    """What remains is then a prefix of another envelope with nothing but zeros behind it.

    No receiver can tell the two apart: `0d 00 00 80 3f` (1.0) without its last byte is also the
    trimmed `0d 00 00 80 00`. The accepted reading is that one, and it is counted as padded.
    """
    cut = envelope[: data.draw(st.integers(0, len(envelope)))]
    whole = restored(cut, LIMIT)
    if whole != cut and accepts(whole):
        assert restored(whole, LIMIT) == whole
        assert restored(whole.rstrip(b"\0"), LIMIT) == whole


def test_a_cut_envelope_is_refused_but_inside_its_last_value() -> None:
    """The limit of framing, spelt out for one message: fields of float32, as the IMU sends them.

    The first byte alone is the empty payload.
    """
    floats = b"".join(tag(number, 5) + b"\x9a\x99\x99\x3f" for number in range(1, 10))
    envelope = framed(13, floats)
    outcomes = {kept: accepts(restored(envelope[:kept], LIMIT)) for kept in range(1, len(envelope))}
    last_value = len(envelope) - 4
    assert [kept for kept, accepted in outcomes.items() if accepted] == [1, *range(last_value, len(envelope))]


def test_all_short_inputs_are_survived() -> None:
    for length in range(3):
        for data in itertools.product(range(256), repeat=length):
            restored(bytes(data), LIMIT)

"""The stream of a tap, in whatever pieces it comes."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.errors import TransportError
from router.observe.tap_stream import MAGIC, Lost, StreamReader, encode, encode_alive, encode_lost
from router.recording.mirror import MirroredDatagram

HOSTS = st.tuples(*[st.integers(0, 255)] * 4).map(lambda parts: ".".join(map(str, parts)))
SEEN = st.builds(
    MirroredDatagram,
    st.integers(0, 2**64 - 1),
    st.text(min_size=1, max_size=60).filter(lambda name: len(name.encode()) < 256),
    st.tuples(HOSTS, st.integers(0, 65535)),
    st.binary(max_size=300),
)
LOST = st.builds(Lost, st.integers(0, 2**64 - 1))


@given(st.lists(st.one_of(SEEN, LOST, st.none()), max_size=8), st.data())
def test_a_stream_reads_as_what_was_written_however_it_is_cut(
    said: list[MirroredDatagram | Lost | None], data: st.DataObject
) -> None:
    stream = MAGIC
    for each in said:
        stream += (
            encode_alive() if each is None else encode_lost(each.number) if isinstance(each, Lost) else encode([each])
        )
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    reader = StreamReader()
    read = [each for start, end in pairwise([0, *cuts, len(stream)]) for each in reader.take(stream[start:end])]
    assert read == [each for each in said if each is not None]


def test_a_batch_is_one_record_after_the_other() -> None:
    batch = [MirroredDatagram(1, "rover", ("10.0.0.1", 8), b"a"), MirroredDatagram(2, "rover", ("10.0.0.2", 9), b"")]
    assert list(StreamReader().take(MAGIC + encode(batch))) == batch


def test_what_a_newer_router_says_is_passed_over() -> None:
    unknown = (3).to_bytes(4, "little") + b"\xf0ab"
    assert list(StreamReader().take(MAGIC + unknown + encode_lost(7))) == [Lost(7)]


@pytest.mark.parametrize("stream", [b"<!doctype html>", b"router tap 2\n"])
def test_another_stream_is_refused(stream: bytes) -> None:
    with pytest.raises(TransportError, match="no stream of a tap"):
        list(StreamReader().take(stream))


@pytest.mark.parametrize("length", [0, 1 << 30])
def test_a_length_that_cannot_be_is_refused(length: int) -> None:
    with pytest.raises(TransportError, match="broken"):
        list(StreamReader().take(MAGIC + length.to_bytes(4, "little") + b"x"))

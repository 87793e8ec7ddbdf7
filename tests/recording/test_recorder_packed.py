"""Datagrams that were packed are what they were, and a ring has no more of them than it may."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from router.engine import MAX_DATAGRAM
from router.recording.mirror import Mirrored
from router.recording.packed import Packer
from router.recording.ring import Ring
from tests.recording.recorder_rig import known, seen

KNOWN = known()
SHOWN: st.SearchStrategy[Mirrored] = st.tuples(
    st.integers(0, 2**63),
    st.sampled_from(["rover", "rövër"]),
    st.tuples(st.sampled_from(["10.0.0.3", "10.0.0.4"]), st.integers(0, 65535)),
    st.binary(max_size=40),
)


@given(st.lists(st.lists(SHOWN, min_size=1)))
def test_what_was_packed_comes_out_as_it_was(batches: Sequence[Sequence[Mirrored]]) -> None:
    packer = Packer()
    packed = [packer.pack(batch, KNOWN, 0, 0) for batch in batches]
    assert [each.unpacked() for each in packed] == batches
    assert [each.before for each in packed] == [sum(map(len, batches[:number])) for number in range(len(batches))]


def test_the_longest_datagram_can_be_packed() -> None:
    batch = seen(bytes(MAX_DATAGRAM + 1))
    assert Packer().pack(batch, KNOWN, 0, 0).unpacked() == batch


def test_senders_without_end_are_not_remembered_without_end() -> None:
    packer, most = Packer(), 0
    for first in range(0, 20_000, 100):
        batch: list[Mirrored] = [(0, "rover", ("10.0.0.3", first + number), b"") for number in range(100)]
        packed = packer.pack(batch, KNOWN, 0, 0)
        most = max(most, len(packed.senders))
        assert packed.unpacked() == batch
    assert most < 5000


def test_a_ring_has_what_came_in_its_time() -> None:
    ring, packer = Ring(10, 1 << 20), Packer()
    for now in range(0, 30, 3):
        ring.add(packer.pack(seen(b"x"), KNOWN, 0, now))
    assert [each.monotonic for each in ring.batches()] == [18, 21, 24, 27]


def test_a_ring_never_takes_more_than_it_may_but_for_the_last_batch() -> None:
    ring, packer = Ring(10**9, 10_000), Packer()
    for now in range(100):
        ring.add(packer.pack(seen(bytes(1000)), KNOWN, 0, now))
        assert sum(each.size for each in ring.batches()) <= 10_000
    ring.add(packer.pack(seen(*[bytes(16_000)] * 4), KNOWN, 0, 100))
    assert len(ring.batches()) == 1

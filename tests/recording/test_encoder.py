"""What goes into a recording comes out of it, whatever it is."""

from __future__ import annotations

import tempfile
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from router.datagrams import Peer
from router.declared import MAX_DATAGRAM
from router.recording.channels import MOST_CHANNELS, Channels
from router.recording.encoder import Encoder, Packer
from router.types.wire import varint
from tests.recording.recorder_rig import (
    MILLISECOND,
    SENSOR_BOARD,
    START,
    STRANGER,
    again,
    batched,
    datagrams,
    imu,
    read,
    recorded,
    seen,
    shown,
    wire,
    write,
)

PEERS = st.sampled_from([SENSOR_BOARD, STRANGER, ("0.0.0.0", 0), ("255.255.255.255", 65535)])
DECISIONS = st.sampled_from(["", "source_mismatch", "malformed"])


@given(st.lists(st.lists(st.tuples(datagrams(), PEERS, DECISIONS), min_size=1), min_size=1))
def test_every_datagram_is_read_as_it_was_seen(batches: list[list[tuple[bytes, Peer, str]]]) -> None:
    at = iter(range(START, START + 10**12, MILLISECOND))
    said = [[shown(data, next(at), peer, reason=reason) for data, peer, reason in batch] for batch in batches]
    with tempfile.TemporaryDirectory() as folder:
        found = read(recorded(Path(folder) / "it.mcap", *said))
    assert [again(each) for each in found] == [each for batch in said for each in batch]
    assert all(each.steady == each.at for each in found)


def test_what_was_rejected_is_on_topics_of_its_own_by_reason(tmp_path: Path) -> None:
    """A stranger's datagrams look like the board's, and are not to be plotted among them."""
    padded = imu(2) + bytes(3)
    path = recorded(
        tmp_path / "it.mcap",
        [*seen(imu(1), padded), *seen(imu(1), padded, peer=STRANGER, reason="source_mismatch")],
        seen(b"\xff", reason="malformed"),
    )
    with path.open("rb") as file:
        topics = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert topics == {
        "imu_info": 2,
        "raw/datagrams": 1,
        "rejected/source_mismatch/imu_info": 2,
        "rejected/source_mismatch/raw/datagrams": 1,
        "rejected/malformed/raw/datagrams": 1,
    }


@pytest.mark.parametrize(
    "size", [0, 1, 100, 125, 127, 128, 129, 16383, MAX_DATAGRAM - 8, MAX_DATAGRAM, MAX_DATAGRAM + 1]
)
def test_datagrams_of_all_lengths_come_back(size: int, tmp_path: Path) -> None:
    case = wire().case("imu_info")
    payload = case.message_class.FromString(varint(2047 << 3 | 2) + varint(size) + bytes(size))
    exact = wire().encode(case, payload)
    encoded = payload.SerializeToString()
    too_short = varint(case.number << 3 | 2) + varint(len(encoded) - 1) + encoded
    shown = [exact, exact + b"\0", exact[:-1], too_short]
    found = read(recorded(tmp_path / "it.mcap", seen(*shown)))
    assert [each.data for each in found] == shown


def test_a_datagram_that_the_router_rejects_has_no_payload_to_look_at(tmp_path: Path) -> None:
    """Of a listener that repairs nothing; zeros at the end are repaired by the other."""
    padded = imu() + bytes(5)
    batch = [
        shown(padded),
        shown(padded, listener="exact", reason="malformed"),
    ]
    channels = Channels()
    messages = Encoder(channels).messages(batched(Packer(), batch))
    by_topic = Counter(channels.channels[message.channel].topic for message in messages)
    assert by_topic == {"raw/datagrams": 1, "imu_info": 1, "rejected/malformed/raw/datagrams": 1}


def test_more_senders_than_there_are_channels_for_lose_nothing() -> None:
    channels = Channels()
    many = [shown(imu(), START + n, (f"10.{n >> 16}.{n >> 8 & 255}.{n & 255}", 1)) for n in range(MOST_CHANNELS + 10)]
    messages = [*Encoder(channels).messages(batched(Packer(), many))]
    assert {message.sequence for message in messages} == set(range(1, len(many) + 1))
    assert len(channels.channels) == MOST_CHANNELS + 2  # the raw datagrams, and their payloads to look at


def test_known_senders_keep_their_channels_over_a_reload_when_there_are_too_many() -> None:
    channels = Channels()
    case = wire().case("imu_info")
    numbers = [
        channels.payload(case, "rover", ("10.0.0.3", port), "sensor_board", "") for port in range(MOST_CHANNELS + 1)
    ]
    assert numbers[-1] is None
    assert channels.payload(case, "rover", ("10.0.0.3", 7), "sensor_board", "") == numbers[7]
    assert channels.payload(case, "rover", ("10.0.0.3", 7), "renamed", "") is None


def test_a_clock_that_is_set_changes_log_times_and_not_what_replaying_goes_by(tmp_path: Path) -> None:
    """A rover without a battery for its clock: GPS comes up, then somebody sets it back."""
    packer = Packer()
    walls = [0, START, START + 20 * MILLISECOND, START // 2, START // 2]
    batches = [
        batched(packer, seen(imu(), at=wall), clocks=(wall, number * 20 * MILLISECOND))
        for number, wall in enumerate(walls)
    ]
    found = read(write(tmp_path / "it.mcap", Channels(), *batches))
    assert [each.at for each in found] == walls
    assert [each.steady for each in found] == [number * 20 * MILLISECOND for number in range(5)]


@given(st.lists(st.tuples(st.integers(0, 10**18), st.integers(0, 10**10)), min_size=2, max_size=20))
def test_steady_times_never_go_back_and_never_run_ahead(clocks: list[tuple[int, int]]) -> None:
    packer, batches = Packer(), []
    now = 0
    for wall, passed in clocks:
        now += passed
        batches.append(batched(packer, seen(imu(), at=wall), clocks=(wall, now)))
    with tempfile.TemporaryDirectory() as folder:
        found = read(write(Path(folder) / "it.mcap", Channels(), *batches))
    assert all(first.steady <= second.steady for first, second in pairwise(found))
    assert found[-1].steady - found[0].steady <= now - clocks[0][1] + 2 * MILLISECOND

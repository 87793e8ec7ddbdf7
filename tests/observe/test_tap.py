"""A tap on what a router receives: what it shows, that a slow reader slows nobody, and the stream in any pieces."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.metrics import REJECT_REASONS
from router.errors import TransportError
from router.observe import tap as tap_module
from router.observe.tap import (
    MAGIC,
    Lost,
    StreamReader,
    Tap,
    TapRequestError,
    encode,
    encode_alive,
    encode_lost,
    wanted,
)
from router.recording.mirror import Action, MirroredDatagram
from tests.acceptance.site import wait_until
from tests.observe.fake_running import FakeRunning, sim_program

PROGRAM = sim_program()
BOARD, STATION, STRANGER = ("127.0.0.30", 25008), ("127.0.0.10", 29000), ("127.0.0.99", 1)


def datagram(case: str) -> bytes:
    """With an empty payload."""
    return PROGRAM.envelopes.first.message_class(**{case: {}}).SerializeToString()


IMU, GPS = datagram("imu_info"), datagram("gps_info")


@pytest.fixture
def running() -> Iterator[FakeRunning]:
    opened = FakeRunning(PROGRAM)
    yield opened
    opened.mirror.close()
    assert opened.failures == []


def read(stream: Iterator[bytes], count: int) -> list[MirroredDatagram | Action | Lost]:
    """So many from the stream, or more if they came together."""
    reader, found = StreamReader(), list[MirroredDatagram | Action | Lost]()
    while len(found) < count:
        found += reader.take(next(stream))
    return found


def test_all_that_is_received_is_shown_as_it_came_with_what_was_decided(running: FakeRunning) -> None:
    with closing(Tap(running.mirror, None)) as tap:
        for data, reason in ((IMU, ""), (b"junk", "malformed"), (b"", "empty")):
            running.receive(data, BOARD, reason=reason)
        running.receive(IMU, STRANGER, reason="source_mismatch")
        shown = read(tap.stream(), 4)
    assert [each[1:] for each in shown if isinstance(each, MirroredDatagram)] == [
        ("rover", BOARD, "sensor_board", "", IMU),
        ("rover", BOARD, "sensor_board", "malformed", b"junk"),
        ("rover", BOARD, "sensor_board", "empty", b""),
        ("rover", STRANGER, "", "source_mismatch", IMU),
    ]


def test_a_tap_shows_actions_unless_it_is_limited_to_what_was_received(running: FakeRunning) -> None:
    actions = [
        Action(7, "sent", "drive", "driving_board", "cmd", data=IMU),
        Action(8, "lost", "drive", "driving_board", "", "stale", "sent 2 s ago"),
        Action(9, "tripped", "drive"),
    ]
    with closing(Tap(running.mirror, None)) as tap:
        running.acted += actions
        assert read(tap.stream(), 3) == actions
    with closing(Tap(running.mirror, wanted(PROGRAM, [], ["sensor_board"]), with_actions=False)) as tap:
        running.acted += actions
        running.receive(IMU, BOARD)
        assert [type(each) for each in read(tap.stream(), 1)] == [MirroredDatagram]


EVERYBODY = ["board imu", "board gps", "station imu", "stranger imu", "IPv6 imu", "link-local imu", "board junk"]


@pytest.mark.parametrize(
    ("cases", "sources", "decisions", "shown"),
    [
        ((), (), (), EVERYBODY),
        (("gps_info",), (), (), ["board gps", "board junk"]),
        (("gps_info", "imu_info"), ("basestation",), (), ["station imu"]),
        ((), ("sensor_board",), (), ["board imu", "board gps", "board junk"]),
        ((), ("127.0.0.99", "basestation"), (), ["station imu", "stranger imu"]),
        ((), ("FD00:0::99", "fe80::1%eth0"), (), ["IPv6 imu", "link-local imu"]),
        ((), (), ("accepted",), ["board imu", "board gps"]),
        ((), (), ("rejected",), EVERYBODY[2:]),
        (("imu_info",), ("sensor_board", "127.0.0.99"), ("rejected",), ["stranger imu", "board junk"]),
        ((), (), ("accepted", "rejected"), EVERYBODY),
    ],
)
def test_a_tap_shows_some_cases_or_senders_or_decisions_only(
    cases: tuple[str, ...], sources: tuple[str, ...], decisions: tuple[str, ...], shown: list[str]
) -> None:
    seen = {
        "board imu": MirroredDatagram(0, "rover", BOARD, "sensor_board", "", IMU),
        "board gps": MirroredDatagram(0, "rover", BOARD, "sensor_board", "", GPS),
        "station imu": MirroredDatagram(0, "rover", STATION, "basestation", "source_mismatch", IMU),
        "stranger imu": MirroredDatagram(0, "rover", STRANGER, "", "source_mismatch", IMU),
        "IPv6 imu": MirroredDatagram(0, "rover", ("fd00::99", 1), "", "source_mismatch", IMU),
        "link-local imu": MirroredDatagram(0, "rover", ("fe80::1%eth0", 1), "", "source_mismatch", IMU),
        "board junk": MirroredDatagram(0, "rover", BOARD, "sensor_board", "malformed", b"\xff\xff\xff"),
    }
    wants = wanted(PROGRAM, cases, sources, decisions)
    assert [name for name, each in seen.items() if wants is None or wants(each)] == shown


def test_a_name_that_there_is_not_is_refused() -> None:
    with pytest.raises(TapRequestError, match="no payload case 'imu_inf'; did you mean 'imu_info'"):
        wanted(PROGRAM, ["imu_inf"], [])
    with pytest.raises(TapRequestError, match="no endpoint 'sensor_bord'; did you mean 'sensor_board'"):
        wanted(PROGRAM, [], ["sensor_bord"])
    with pytest.raises(TapRequestError, match=r"fe80::1 is link-local, .*; write its network interface"):
        wanted(PROGRAM, [], ["fe80::1"])
    with pytest.raises(TapRequestError, match="'only' must be accepted or rejected, not 'reject'"):
        wanted(PROGRAM, [], [], ["reject"])


def test_a_reader_who_is_too_slow_is_told_how_many_he_missed(
    running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tap_module, "MAX_WAITING", 1000)
    with closing(Tap(running.mirror, None)) as tap:
        stream = tap.stream()
        next(stream)
        for _ in range(50):
            running.receive(bytes(300), BOARD)
        wait_until(lambda: not running.waiting)
        running.receive(IMU, BOARD)
        reader, seen, lost = StreamReader(), 0, 0
        list(reader.take(MAGIC))
        while seen + lost < 51:
            for each in reader.take(next(stream)):
                seen, lost = (seen, lost + each.number) if isinstance(each, Lost) else (seen + 1, lost)
    assert lost >= 47
    assert seen + lost == 51


def test_a_quiet_tap_says_that_it_is_there_and_ends_when_it_is_closed(
    running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tap_module, "ALIVE_SECONDS", 0.01)
    tap = Tap(running.mirror, None)
    stream = tap.stream()
    pieces = [next(stream) for _ in range(3)]
    assert list(StreamReader().take(b"".join(pieces))) == []
    assert all(pieces)
    monkeypatch.setattr(tap_module, "ALIVE_SECONDS", 60)
    reading = threading.Thread(target=lambda: list(stream))
    reading.start()
    tap.close()
    reading.join(10)
    assert not reading.is_alive()


# ---- the stream -------------------------------------------------------------------------------------------------

HOSTS = st.one_of(st.ip_addresses().map(str), st.ip_addresses(v=6).map(lambda address: f"{address}%wlan0"))
SEEN = st.builds(
    MirroredDatagram,
    st.integers(0, 2**64 - 1),
    st.text(min_size=1, max_size=60),
    st.tuples(HOSTS, st.integers(0, 65535)),
    st.text(max_size=60),
    st.sampled_from(["", *REJECT_REASONS]),
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


def test_what_a_newer_router_says_is_passed_over() -> None:
    unknown = (3).to_bytes(4, "little") + b"\xf0ab"
    assert list(StreamReader().take(MAGIC + unknown + encode_lost(7))) == [Lost(7)]


@pytest.mark.parametrize("stream", [b"<!doctype html>", b"router tap 2\n"])
def test_another_stream_is_refused(stream: bytes) -> None:
    with pytest.raises(TransportError, match="not a tap stream"):
        list(StreamReader().take(stream))


@pytest.mark.parametrize("length", [0, 1 << 30])
def test_a_length_that_cannot_be_is_refused(length: int) -> None:
    with pytest.raises(TransportError, match="corrupt"):
        list(StreamReader().take(MAGIC + length.to_bytes(4, "little") + b"x"))

"""Which datagram reaches which handler, and why the others do not; held against an oracle without shortcuts."""

from __future__ import annotations

import itertools
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.fuzz_engine import fuzz
from router.compiler.metrics import REJECT_REASONS
from router.compiler.program import Program
from router.datagrams import Peer
from router.types.framing import MAX_DATAGRAM
from tests.engine.rig import (
    BASESTATION,
    DRIVING_BOARD,
    HEAD,
    HEAD_OF_LISTENERS,
    LEFT_TOOL,
    RIGHT_TOOL,
    SENSOR_BOARD,
    STRANGER,
    Rig,
    program,
)
from tests.engine.wire import LEN, damaged, framed, tag, varint
from tests.oracles.engine import Naive

ROUTES = """\
  imu_info:
    source: sensor_board
    destinations: [basestation, recorder]
    topics: [{topic: imu_data, type: comms/msg/ImuSensorInformation, fields: auto}]
  drive_diag:
    source: any
    destinations: [recorder]
    topics: [{topic: drive_diag, type: comms/msg/DrivingBoardDiagnostics, fields: auto}]
  gps_info:
    source: [left_tool, basestation]
    topics: [{topic: gps_data, type: comms/msg/SensorBoardGPSInfo, fields: auto}]
  arm_pos: {source: right_tool, destinations: [basestation]}
  manual_drive: {source: basestation, destinations: [driving_board]}
  ph_info: {ignore: nobody measures it here}
"""
PEERS = [
    SENSOR_BOARD,
    DRIVING_BOARD,
    BASESTATION,
    LEFT_TOOL,
    RIGHT_TOOL,
    STRANGER,
    ("192.168.0.60", 1),
    ("192.168.0.30", 9),
]

IMU, GPS, ARM_POS, DRIVE_DIAG, MANUAL_DRIVE, PH = 13, 12, 5, 8, 24, 1
UNKNOWN = 99
X_IS_ONE = bytes.fromhex("0d0000803f")
Y_IS_TWO = bytes.fromhex("1500000040")
TIMEOUT = tag(30, 0) + varint(250)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return program(tmp_path_factory.mktemp("dispatch"), ROUTES)


@pytest.fixture
def rig(made: Program) -> Rig:
    return Rig(made)


# ---- the oracle


class Both:
    """Engine and oracle side by side; `receive` asserts that they did the same: all of the counters, every byte out."""

    def __init__(self, made: Program) -> None:
        self.rig, self.expected = Rig(made), Rig(made)
        self.naive = Naive(self.expected)

    def receive(self, data: bytes, peer: Peer, listener: str) -> None:
        self.rig.receive(data, peer, listener)
        self.naive.receive(data, peer, listener)
        differences = self.differences() if self.rig.counts != self.expected.counts else []
        out = [(list(rig.sent), list(rig.published)) for rig in (self.rig, self.expected)]
        for rig in (self.rig, self.expected):  # begin anew, so that the next datagram is judged by itself
            rig.counts[:] = rig.program.counters.fresh_counts()
            rig.sent.clear()
            rig.published.clear()
        assert not differences
        assert out[0] == out[1]

    def differences(self) -> list[tuple[object, int, int]]:
        series = self.rig.program.counters.series()
        both = [(one, self.rig.counts[index], self.expected.counts[index]) for one, index in series]
        return [(one, ours, theirs) for one, ours, theirs in both if ours != theirs]


@pytest.fixture(scope="module")
def both(made: Program) -> Both:
    return Both(made)


@pytest.fixture(scope="module")
def both_of_listeners(tmp_path_factory: pytest.TempPathFactory) -> Both:
    """Where endpoints are believed by one listener each: two of them have one address."""
    routes = """\
  imu_info: {source: sensor_board, destinations: [recorder]}
  manual_drive: {source: basestation, destinations: [driving_board]}
  gps_info: {source: impostor, destinations: [basestation]}
  arm_pos: {source: [left_tool, right_tool], destinations: [basestation]}
  drive_diag: {source: any, destinations: [recorder]}
"""
    return Both(program(tmp_path_factory.mktemp("listeners"), routes, HEAD_OF_LISTENERS))


@settings(max_examples=10 * settings().max_examples)
@given(data=damaged(), peer=st.sampled_from(PEERS), listener=st.sampled_from(["trimmed", "exact"]))
def test_both_paths_agree_with_the_protobuf_library(
    both: Both, both_of_listeners: Both, data: bytes, peer: Peer, listener: str
) -> None:
    both.receive(data, peer, listener)
    both_of_listeners.receive(data, peer, listener)


def test_every_case_from_every_sender_is_taken_as_the_names_of_endpoints_say(
    both: Both, both_of_listeners: Both
) -> None:
    for number, peer, listener in itertools.product(range(1, 30), PEERS, ("trimmed", "exact")):
        both.receive(framed(number, b""), peer, listener)
        both_of_listeners.receive(framed(number, b""), peer, listener)


def test_short_datagrams_agree_with_the_protobuf_library(made: Program) -> None:
    """Two bytes, all of the first with a fifth of the second; and three that begin like an envelope."""
    both = Both(made)
    firsts = [0x00, 0x08, 0x6A, 0x42, 0xC2, 0xEA, 0x82, 0xFF]
    short = [bytes(pair) for pair in itertools.product(range(256), range(0, 256, 5))]
    short += [bytes((first, *pair)) for first in firsts for pair in itertools.product(range(0, 256, 15), repeat=2)]
    for data in short:
        both.receive(data, SENSOR_BOARD, "exact")


def test_tags_of_three_bytes_are_told_from_those_of_two(tmp_path: Path) -> None:
    """The first two bytes of `82 80 0e`, with which 28672 begins, look like 2048 and the third like its length.

    This payload even parses when its own length is taken for its first tag.
    """
    (tmp_path / "wide.proto").write_text(
        'syntax = "proto3"; message Point { float x = 1; }'
        "message Wide { oneof payload { Point near = 13; Point far = 2048; Point farther = 28672; } }"
    )
    head = HEAD.replace("PBEnvelope", "Wide")
    routes = "".join(f"  {case}: {{source: any, destinations: [basestation]}}\n" for case in ("near", "far", "farther"))
    both = Both(program(tmp_path, routes, head, tmp_path))
    ambiguous = bytes.fromhex("0d0000000d 0d00000090 108801")
    for payload, number in itertools.product((b"", X_IS_ONE, ambiguous), (13, 2048, 28672)):
        both.receive(framed(number, payload), SENSOR_BOARD, "exact")


# ---- why a datagram is rejected


REJECTED = [
    ("truncated", framed(DRIVE_DIAG, bytes(MAX_DATAGRAM))),
    ("truncated", bytes(MAX_DATAGRAM + 1)),
    ("empty", b""),
    ("malformed", framed(IMU, X_IS_ONE[:3])),
    ("malformed", framed(IMU, X_IS_ONE) + tag(30, 0) + b"\x80"),
    ("malformed", b"\xff" * 20),
    ("no_payload", bytes(4)),
    ("unknown_case", framed(UNKNOWN, X_IS_ONE)),
    ("unknown_case", TIMEOUT),
    ("unhandled", framed(MANUAL_DRIVE + 1, b"")),
    ("ignored", framed(PH, b"")),
    ("source_mismatch", framed(GPS, b"")),
]


@pytest.mark.parametrize(("reason", "data"), REJECTED)
def test_a_datagram_that_no_route_takes_is_counted_with_its_reason(rig: Rig, reason: str, data: bytes) -> None:
    rig.receive(data)

    assert rig.rejected() == reason
    assert (rig.sent, rig.published) == ([], [])
    assert [report.reason for report in rig.reports] == ([] if reason == "ignored" else [reason])
    rig.assert_counters_balance()


def test_every_reason_has_its_datagram() -> None:
    assert {reason for reason, _ in REJECTED} == set(REJECT_REASONS)


@pytest.mark.parametrize(("number", "detail"), [(UNKNOWN, "field 99"), (GPS, "gps_info")])
def test_a_report_names_the_sender_and_what_it_sent(rig: Rig, number: int, detail: str) -> None:
    rig.receive(framed(number, b""), STRANGER)
    [report] = rig.reports
    assert (report.kind, report.place, report.detail) == ("reject", "trimmed", f"from 192.168.0.99:1234: {detail}")


def test_unhandled_cases_are_counted_by_name(rig: Rig) -> None:
    rig.receive(framed(MANUAL_DRIVE + 1, b""))
    rig.receive(framed(UNKNOWN, b""))
    assert rig.counted("unhandled") == {("unhandled", "manual_brake"): 1, ("unhandled", "unknown"): 1}


def test_a_malformed_payload_is_malformed_whoever_sent_it(rig: Rig) -> None:
    """Also where the sender would not do either: both paths judge in one order."""
    rig.receive(framed(IMU, X_IS_ONE[:3]), STRANGER)
    rig.receive(framed(IMU, X_IS_ONE[:3]) + TIMEOUT, STRANGER)
    assert rig.count("datagrams_rejected", "trimmed", "malformed") == 2


# ---- forms of one envelope


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(framed(IMU, X_IS_ONE + Y_IS_TWO), id="plain"),
        pytest.param(tag(IMU, LEN) + b"\x8a\x00" + X_IS_ONE + Y_IS_TWO, id="overlong length"),
        pytest.param(b"\xea\x00\x0a" + X_IS_ONE + Y_IS_TWO, id="overlong tag"),
        pytest.param(framed(IMU, X_IS_ONE) + framed(IMU, Y_IS_TWO), id="in two pieces"),
        pytest.param(framed(GPS, b"") + framed(IMU, X_IS_ONE + Y_IS_TWO), id="behind another case"),
        pytest.param(TIMEOUT + framed(IMU, X_IS_ONE + Y_IS_TWO), id="behind an unknown field"),
        pytest.param(framed(IMU, X_IS_ONE + Y_IS_TWO) + TIMEOUT, id="before an unknown field"),
        pytest.param(framed(IMU, Y_IS_TWO + X_IS_ONE), id="in another order"),
    ],
)
@pytest.mark.parametrize("listener", ["trimmed", "exact"])
def test_all_forms_of_an_envelope_mean_the_same(rig: Rig, data: bytes, listener: str) -> None:
    rig.receive(data, listener=listener)

    assert rig.rejected(listener) is None
    assert rig.sent == [("basestation", data), ("recorder", data)]
    [(topic, cdr)] = rig.published
    assert topic == "imu_data"
    assert struct.unpack_from("<4x3f", cdr) == (1.0, 2.0, 0.0)


# ---- zeros at the end

ALL_ZERO = framed(IMU, b"\x0d" + bytes(4))


@pytest.mark.parametrize("data", [ALL_ZERO.rstrip(b"\0"), ALL_ZERO[:-1], ALL_ZERO + bytes(1), ALL_ZERO + bytes(40)])
def test_zeros_are_repaired_where_the_listener_says_so(rig: Rig, data: bytes) -> None:
    rig.receive(data)
    rig.receive(data, listener="exact")

    assert rig.count("datagrams_padded", "trimmed") == 1
    assert rig.rejected("trimmed") is None
    assert rig.count("datagrams_padded", "exact") == 0
    assert rig.rejected("exact") == "malformed"


def test_what_is_forwarded_is_the_restored_envelope(rig: Rig) -> None:
    """A complete one to the byte, without a new encoding. The endpoint that wants its zeros removed gets it so."""
    long_tag, long_size = b"\xea\x00\x00", b"\x6a\x80\x00"
    whole = {
        ALL_ZERO: ALL_ZERO,
        ALL_ZERO.rstrip(b"\0"): ALL_ZERO,
        ALL_ZERO + bytes(9): ALL_ZERO,
        ALL_ZERO + TIMEOUT: ALL_ZERO + TIMEOUT,
        long_tag: long_tag,
        long_size: long_size,
        long_size[:-1]: long_size,
    }
    for data in whole:
        rig.receive(data)
    forwarded = list(whole.values())
    assert [data for endpoint, data in rig.sent if endpoint == "basestation"] == forwarded
    assert [data for endpoint, data in rig.sent if endpoint == "recorder"] == [
        data if data == long_tag else data.rstrip(b"\0")
        for data in forwarded  # a cut tag could not be restored
    ]
    assert rig.count("sent_bytes", "imu_info", "basestation") == sum(map(len, forwarded))


# ---- who sent it


@pytest.mark.parametrize(
    ("number", "peer", "label"),
    [
        (IMU, SENSOR_BOARD, "sensor_board"),
        (IMU, ("192.168.0.30", 9), "sensor_board"),  # one endpoint to the address: the port says nothing
        (IMU, DRIVING_BOARD, None),
        (IMU, STRANGER, None),
        (GPS, LEFT_TOOL, "left_tool"),
        (GPS, BASESTATION, "basestation"),
        (GPS, RIGHT_TOOL, None),
        (GPS, ("192.168.0.60", 7001), None),  # where it listens is not where it sends from
        (ARM_POS, RIGHT_TOOL, "right_tool"),
        (ARM_POS, LEFT_TOOL, None),
        (DRIVE_DIAG, DRIVING_BOARD, "driving_board"),
        (DRIVE_DIAG, LEFT_TOOL, "left_tool"),
        (DRIVE_DIAG, STRANGER, "unknown"),
        (DRIVE_DIAG, ("192.168.0.60", 1), "unknown"),
    ],
)
def test_a_route_takes_its_sources_only(rig: Rig, number: int, peer: Peer, label: str | None) -> None:
    rig.receive(framed(number, b""), peer)
    found = rig.counted("messages_received")
    if label is None:
        assert found == {}
        assert rig.rejected() == "source_mismatch"
    else:
        assert [(labels[2], count) for labels, count in found.items()] == [(label, 1)]


def test_an_endpoint_is_seen_whatever_it_sent(rig: Rig) -> None:
    rig.now = 5
    for data, peer in ((b"\xff", SENSOR_BOARD), (framed(GPS, b""), RIGHT_TOOL), (b"", STRANGER)):
        rig.receive(data, peer)
    seen = {name for name in rig.program.table.endpoints if rig.count("endpoint_last_seen_timestamp_seconds", name)}
    assert seen == {"sensor_board", "right_tool"}
    assert rig.count("endpoint_last_seen_timestamp_seconds", "right_tool") == rig.WALL + 5


def test_damaged_datagrams_are_counted_and_nothing_else() -> None:
    outcome = fuzz(30_000, seed=7)
    assert outcome.findings == []
    assert outcome.fates["accepted"] > 3_000
    unheard_of = [reason for reason in REJECT_REASONS if not outcome.fates[f"rejected {reason}"]]
    assert unheard_of == ["ignored"], "the rover ignores nothing; all else should have happened"
